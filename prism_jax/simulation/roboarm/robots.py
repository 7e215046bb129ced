"""Arms read from URDF, and posed.

The format is the XML robot description of ROS (https://wiki.ros.org/urdf/XML). Files
are parsed, never executed, also those in its macro language (`xacro`): no network, and
no mesh is looked for outside of this machine's files. Lengths are metres, angles
radians, and a robot's frame is that of its root link, x y z as the file has it.
"""

import io
import pathlib
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, Float64, Int
from scipy.spatial.transform import Rotation

from prism_jax.io.errors import InputError
from prism_jax.simulation.roboarm.furnishings import to_mesh, together
from prism_jax.simulation.roboarm.models import ArmModel, urdf_path
from prism_jax.simulation.roboarm.packages import named_file
from prism_jax.simulation.roboarm.xacro import plain_urdf, robot_xml
from prism_jax.simulation.solids import box

MESH_SUFFIXES = (".dae", ".obj", ".ply", ".stl")
POINTS_PER_LINK = 80
MAX_TURN = 2.5
"""Radians to each side of the middle of its range that a joint is turned at most."""
_MOVING = ("revolute", "continuous", "prismatic")
_REMEDY = "mend the URDF, or name that of another robot"


class Robot:
    """An arm: its links' meshes, its joints, and where joint positions put the links.

    A link is a link of the file that has a mesh. `joints` are those that move on their
    own, `lower` and `upper` their limits (radians, metres), narrowed to `MAX_TURN`.

    Attributes:
      spacer: height of what the root stands on, which is not part of the meshes.
      bodies: for each link, the number of the part that moves as one: 0 is the root's.
        A joint that mimics another starts no part of its own.
      parents: for each body, the one that carries it; the root's is 0.
      probes: points on the links' surfaces, in the frames of the links
        `probe_links`: what collisions are looked for with, as many on every link.
      probe_weights: the share of the surface that each probe stands for.
    """

    def __init__(self, model: ArmModel):
        self.name, self.spacer = model.name, model.spacer
        path = urdf_path(model)
        links, self._chain = _subtree(_parse(path), model.root, path)
        moving = [joint for joint in self._chain if _moves(joint)]
        self.joints = tuple(joint.name for joint in moving)
        limits = np.array([_limits(joint, path) for joint in moving]).reshape(-1, 2)
        self.lower, self.upper = limits[:, 0], limits[:, 1]
        self._frames = [link.name for link in links]
        self._mount = np.eye(4)
        self._mount[:3, :3] = Rotation.from_euler(
            "xyz", model.roll_pitch_yaw, degrees=True
        ).as_matrix()
        self.meshes, self._link_frames = [], []
        for index, link in enumerate(links):
            shapes = _link_shapes(link, path)
            if link.name == model.tool_link:
                shapes.append(_gripper(model.tool_axis))
            if shapes:
                self.meshes.append(together(shapes))
                self._link_frames.append(index)
        self.link_names = tuple(self._frames[index] for index in self._link_frames)
        if not self.meshes:
            raise InputError(path, "has no link with a shape", _REMEDY)
        self._stand_on_the_ground()
        self._number_bodies()
        self._place_probes()
        self.faces_link = np.repeat(
            np.arange(len(self.meshes)), [len(mesh.faces) for mesh in self.meshes]
        )

    def link_poses(
        self, positions: Float[np.ndarray, "P J"]
    ) -> Float64[np.ndarray, "P L 4 4"]:
        """Where joint positions put each link: its frame in the robot's."""
        return self._frame_poses(positions)[:, self._link_frames]

    def frame_pose(
        self, name: str, positions: Float[np.ndarray, " J"]
    ) -> Float64[np.ndarray, "4 4"]:
        """Where joint positions put a link's frame, which may have no mesh."""
        return self._frame_poses(positions[None])[0, self._frames.index(name)]

    def chain_to(self, name: str) -> list[str]:
        """A link with a mesh of each part that moves as one, from the root to the part
        that a frame is on; the link with the largest surface."""
        body, bodies = self._body[name], []
        while body not in bodies:
            bodies.insert(0, body)
            body = self.parents[body]
        areas = np.array([mesh.area for mesh in self.meshes])
        chain = []
        for body in bodies:
            links = np.flatnonzero(self.bodies == body)
            if len(links):
                chain.append(self.link_names[links[np.argmax(areas[links])]])
        return chain

    def mesh(self, positions: Float[np.ndarray, " J"]) -> trimesh.Trimesh:
        """All links in one pose: `faces_link` names each face's link."""
        placed = [
            trimesh.Trimesh(
                mesh.vertices @ pose[:3, :3].T + pose[:3, 3], mesh.faces, process=False
            )
            for mesh, pose in zip(
                self.meshes, self.link_poses(positions[None])[0], strict=True
            )
        ]
        return together(placed)

    def probe_points(
        self, positions: Float[np.ndarray, "P J"]
    ) -> Float64[np.ndarray, "P N 3"]:
        """The probes in the robot's frame, for each of the positions."""
        poses = self.link_poses(positions)[:, self.probe_links]
        turned = np.einsum("pnij,nj->pni", poses[..., :3, :3], self.probes)
        return turned + poses[..., :3, 3]

    def _frame_poses(self, positions: np.ndarray) -> np.ndarray:
        """Every frame of the chain, meshes or not."""
        if positions.shape[1:] != (len(self.joints),):
            raise ValueError(f"{self.name} has {len(self.joints)} joints")
        own = dict(zip(self.joints, positions.T, strict=True))
        poses = {self._frames[0]: np.broadcast_to(self._mount, (len(positions), 4, 4))}
        for joint in self._chain:
            if joint.child == self._frames[0]:
                carrier = poses[joint.child]
                poses[joint.child] = carrier @ _motion(joint, own, len(positions))
                continue
            origin = np.eye(4) if joint.origin is None else joint.origin
            motion = _motion(joint, own, len(positions))
            poses[joint.child] = poses[joint.parent] @ origin @ motion
        return np.stack([poses[name] for name in self._frames], axis=1)

    def _stand_on_the_ground(self) -> None:
        """Lifts the mount so that the first link's lowest point is at the spacer's."""
        pose = self.link_poses(np.clip(0.0, self.lower, self.upper)[None])[0, 0]
        base = self.meshes[0].vertices @ pose[2, :3] + pose[2, 3]
        self._mount[2, 3] = self.spacer - base.min()

    def _number_bodies(self) -> None:
        body, self.parents = {self._frames[0]: 0}, [0]
        for joint in self._chain:
            if joint.child == self._frames[0]:
                continue
            carrier = body[joint.parent]
            if _moves(joint):
                body[joint.child] = len(self.parents)
                self.parents.append(carrier)
            else:
                body[joint.child] = carrier
        self._body = body
        numbers = [body[name] for name in self.link_names]
        self.bodies: Int[np.ndarray, " L"] = np.array(numbers)

    def _place_probes(self) -> None:
        rng = np.random.default_rng(0)
        sampled = [
            trimesh.sample.sample_surface(mesh, POINTS_PER_LINK, seed=rng)[0]
            for mesh in self.meshes
        ]
        self.probes = np.concatenate(sampled)
        self.probe_links = np.repeat(np.arange(len(sampled)), POINTS_PER_LINK)
        areas = np.array([mesh.area for mesh in self.meshes])[self.probe_links]
        self.probe_weights: Float64[np.ndarray, " N"] = areas / areas.sum()


def _parse(path: pathlib.Path) -> Any:
    """The file's robot: yourdfpy's dataclasses."""
    try:
        import yourdfpy
    except ModuleNotFoundError:
        raise InputError(
            "yourdfpy",
            "is not installed",
            'install the extra: pip install "prism_jax[robots]"',
        ) from None
    data = plain_urdf(path) if path.suffix == ".xacro" else robot_xml(path)
    try:
        return yourdfpy.URDF.load(
            io.BytesIO(data), build_scene_graph=False, load_meshes=False
        ).robot
    except Exception as error:  # its parser raises whatever a malformed file leads to
        fault = f"is not a URDF robot: {type(error).__name__} {error}"
        raise InputError(path, fault, _REMEDY) from None


def _subtree(robot: Any, root: str | None, path: pathlib.Path) -> tuple[list, list]:
    """The links from the root down, and the joints above them, parents first."""
    carriers = {joint.child: joint for joint in robot.joints}
    links = {link.name: link for link in robot.links}
    tops = [name for name in links if name not in carriers]
    if root is None:
        root = tops[0] if len(tops) == 1 else None
    if root not in links:
        raise InputError(path, f"has no single root link {root or ''}", _REMEDY)
    found = [root]
    chain = [carriers[root]] if root in carriers else []
    for name in found:
        for joint in robot.joints:
            if joint.parent == name:
                if joint.child in found or joint.child not in links:
                    fault = f"has a loop or a gap at its joint {joint.name!r}"
                    raise InputError(path, fault, _REMEDY)
                found.append(joint.child)
                chain.append(joint)
    return [links[name] for name in found], chain


def _moves(joint: Any) -> bool:
    return joint.type in _MOVING and joint.mimic is None


def _limits(joint: Any, path: pathlib.Path) -> tuple[float, float]:
    limit = joint.limit
    if (
        joint.type == "continuous"
        or limit is None
        or None in (limit.lower, limit.upper)
    ):
        return -MAX_TURN, MAX_TURN
    lower, upper = float(limit.lower), float(limit.upper)
    if not -np.inf < lower <= upper < np.inf:
        fault = f"limits its joint {joint.name!r} to {lower:g} to {upper:g}"
        raise InputError(path, fault, _REMEDY)
    if joint.type == "prismatic":
        return lower, upper
    middle = (lower + upper) / 2
    return max(lower, middle - MAX_TURN), min(upper, middle + MAX_TURN)


def _motion(joint: Any, positions: dict, count: int) -> Float64[np.ndarray, "P 4 4"]:
    """What the joint adds to its origin; a mimic follows the joint that it names."""
    motion = np.tile(np.eye(4), (count, 1, 1))
    if joint.type not in _MOVING:
        return motion
    if joint.mimic is None:
        value = positions[joint.name]
    else:
        followed = positions.get(joint.mimic.joint, np.zeros(count))
        value = followed * joint.mimic.multiplier + joint.mimic.offset
    axis = np.asarray(joint.axis, float)
    if joint.type == "prismatic":
        motion[:, :3, 3] = value[:, None] * axis
    else:
        turn = value[:, None] * axis / np.linalg.norm(axis)
        motion[:, :3, :3] = Rotation.from_rotvec(turn).as_matrix()
    return motion


def _link_shapes(link: Any, path: pathlib.Path) -> list[trimesh.Trimesh]:
    """What is seen of a link, or where the file shows nothing, what may be touched."""
    placed = []
    for shape in link.visuals or link.collisions or []:
        mesh = _shape_mesh(shape.geometry, path)
        if shape.origin is not None:
            mesh.apply_transform(shape.origin)
        placed.append(mesh)
    return placed


def _shape_mesh(geometry: Any, path: pathlib.Path) -> trimesh.Trimesh:
    if geometry.box is not None:
        return trimesh.creation.box(geometry.box.size)
    if geometry.cylinder is not None:
        cylinder = geometry.cylinder
        return trimesh.creation.cylinder(cylinder.radius, cylinder.length, sections=24)
    if geometry.sphere is not None:
        return trimesh.creation.uv_sphere(geometry.sphere.radius, count=(16, 16))
    file = _mesh_file(geometry.mesh.filename, path)
    try:
        loaded = trimesh.load_mesh(file, skip_materials=True, process=False)
        mesh = trimesh.Trimesh(loaded.vertices, loaded.faces, process=False)
        if loaded.units not in (None, "meters"):
            metres = trimesh.units.unit_conversion(loaded.units, "meters")
            mesh.vertices = mesh.vertices * metres
    except Exception as error:  # one parser for each format, each with its own errors
        fault = f"is not a readable mesh: {type(error).__name__}"
        raise InputError(file, fault, "export it again as STL") from None
    if len(mesh.faces) == 0 or not np.isfinite(mesh.vertices).all():
        raise InputError(file, "has no triangles", "export it again as STL")
    if geometry.mesh.scale is not None:
        mesh.vertices = mesh.vertices * np.broadcast_to(geometry.mesh.scale, 3)
    return mesh


def _mesh_file(name: str, urdf: pathlib.Path) -> pathlib.Path:
    """The file of a mesh that a robot's file names."""
    place = named_file(name, urdf)
    if place is None:
        raise InputError(urdf, f"names a mesh {name!r} that is not there", _REMEDY)
    if place.suffix.lower() not in MESH_SUFFIXES:
        fault = f"is no mesh of {' '.join(MESH_SUFFIXES)}"
        raise InputError(place, fault, "convert it to STL")
    return place


def _gripper(axis: str) -> trimesh.Trimesh:
    """Two fingers on a palm, 0.16 m long, along +x or +z of its link."""
    solids = [box((0, 0, 0.035), (0.07, 0.1, 0.07), 0.008)]
    for side in (-1, 1):
        solids.append(box((0, side * 0.037, 0.115), (0.024, 0.014, 0.09), 0.003))
    mesh = to_mesh(solids)
    if axis == "x":
        mesh.vertices = mesh.vertices[:, [2, 0, 1]]
    return mesh
