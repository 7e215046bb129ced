"""Robots read from URDF: the shapes of their links, and where joint positions put them.

The format is the XML robot description of ROS (https://wiki.ros.org/urdf/XML). Files
are parsed, never executed, also those in its macro language (`xacro`), and nothing is
fetched. Lengths are metres, angles radians, and a robot's frame is that of its root
link. The extra `robots` reads the XML and the meshes.
"""

import io
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, Float64, Int
from scipy.spatial.transform import Rotation

from prism_jax.io.errors import InputError, StrPath, require
from prism_jax.robots.xacro import named_file, plain_urdf, robot_xml

MESH_SUFFIXES = (".dae", ".obj", ".ply", ".stl")
REMEDY = "fix the URDF, or use another one"
_EXTRA = "robots"
_MOVING = ("revolute", "continuous", "prismatic")


class Linkage:
    """A robot's links, their triangles, and where joint positions put them.

    A link is a link of the file that has a mesh; `meshes` (`trimesh.Trimesh`, each in
    its own frame) and `link_names` are in one order. `joints` are the names of those
    that move on their own, `chain` the file's joints below the root, parents first.
    """

    def __init__(
        self,
        path: StrPath,
        root: str | None = None,
        mount: Float[np.ndarray, "4 4"] | None = None,
        tools: Mapping[str, Any] | None = None,
    ):
        """Reads a file, URDF or xacro; one that is no robot raises InputError. Of it
        what is below the link `root`, whose pose in the robot's frame is `mount`, by
        default the identity. `tools` are further meshes by the links that carry them,
        in their frames."""
        path = pathlib.Path(path)
        links, self.chain = _subtree(_parse(path), root, path)
        self.moving = [joint for joint in self.chain if moves(joint)]
        self.joints = tuple(joint.name for joint in self.moving)
        self.frames = [link.name for link in links]
        self.mount = np.eye(4) if mount is None else np.array(mount, np.float64)
        self.meshes, self._link_frames = [], []
        for index, link in enumerate(links):
            shapes = _link_shapes(link, path)
            if tools and link.name in tools:
                shapes.append(tools[link.name])
            if shapes:
                self.meshes.append(_joined(shapes))
                self._link_frames.append(index)
        self.link_names = tuple(self.frames[index] for index in self._link_frames)
        if not self.meshes:
            raise InputError(path, "no link has geometry", REMEDY)

    def link_poses(
        self, positions: Float[np.ndarray, "P J"]
    ) -> Float64[np.ndarray, "P L 4 4"]:
        """Where joint positions put each link: its frame in the robot's."""
        return self._frame_poses(positions)[:, self._link_frames]

    def frame_pose(
        self, name: str, positions: Float[np.ndarray, " J"]
    ) -> Float64[np.ndarray, "4 4"]:
        """Where joint positions put a link's frame, which may have no mesh."""
        return self._frame_poses(positions[None])[0, self.frames.index(name)]

    def triangles(
        self, positions: Float[np.ndarray, " J"]
    ) -> tuple[Float64[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
        """Vertices and faces of all links in one pose, link by link."""
        trimesh, poses = require("trimesh", _EXTRA), self.link_poses(positions[None])[0]
        placed = [
            mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
            for mesh, pose in zip(self.meshes, poses, strict=True)
        ]
        return trimesh.util.append_faces(placed, [mesh.faces for mesh in self.meshes])

    def _frame_poses(self, positions: np.ndarray) -> np.ndarray:
        """Every frame of the chain, meshes or not."""
        if positions.shape[1:] != (len(self.joints),):
            raise ValueError(f"the robot has {len(self.joints)} joints")
        own = dict(zip(self.joints, positions.T, strict=True))
        poses = {self.frames[0]: np.broadcast_to(self.mount, (len(positions), 4, 4))}
        for joint in self.chain:
            motion = _motion(joint, own, len(positions))
            if joint.child == self.frames[0]:
                poses[joint.child] = poses[joint.child] @ motion
                continue
            origin = np.eye(4) if joint.origin is None else joint.origin
            poses[joint.child] = poses[joint.parent] @ origin @ motion
        return np.stack([poses[name] for name in self.frames], axis=1)


def moves(joint: Any) -> bool:
    """Whether a joint of a file moves on its own."""
    return joint.type in _MOVING and joint.mimic is None


def _parse(path: pathlib.Path) -> Any:
    """The file's robot: yourdfpy's dataclasses."""
    yourdfpy = require("yourdfpy", _EXTRA)
    data = plain_urdf(path) if path.suffix == ".xacro" else robot_xml(path)
    options = {"build_scene_graph": False, "load_meshes": False}
    try:
        return yourdfpy.URDF.load(io.BytesIO(data), **options).robot
    except Exception as error:  # its parser raises whatever a malformed file leads to
        fault = f"not a valid URDF robot: {type(error).__name__} {error}"
        raise InputError(path, fault, REMEDY) from None


def _subtree(robot: Any, root: str | None, path: pathlib.Path) -> tuple[list, list]:
    """The links from the root down, and the joints above them, parents first."""
    carriers = {joint.child: joint for joint in robot.joints}
    links = {link.name: link for link in robot.links}
    tops = [name for name in links if name not in carriers]
    if root is None:
        root = tops[0] if len(tops) == 1 else None
    if root not in links:
        raise InputError(path, f"no unique root link {root or ''}", REMEDY)
    found = [root]
    chain = [carriers[root]] if root in carriers else []
    for name in found:
        for joint in robot.joints:
            if joint.parent == name:
                if joint.child in found or joint.child not in links:
                    fault = f"loop or gap at joint {joint.name!r}"
                    raise InputError(path, fault, REMEDY)
                found.append(joint.child)
                chain.append(joint)
    return [links[name] for name in found], chain


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


def _joined(meshes: list[Any]) -> Any:
    """The meshes as one, their triangles in order."""
    trimesh = require("trimesh", _EXTRA)
    parts = [mesh.vertices for mesh in meshes], [mesh.faces for mesh in meshes]
    return trimesh.Trimesh(*trimesh.util.append_faces(*parts), process=False)


def _link_shapes(link: Any, path: pathlib.Path) -> list[Any]:
    """What is seen of a link, or where the file shows nothing, what may be touched."""
    placed = []
    for shape in link.visuals or link.collisions or []:
        mesh = _shape_mesh(shape.geometry, path)
        if shape.origin is not None:
            mesh.apply_transform(shape.origin)
        placed.append(mesh)
    return placed


def _shape_mesh(geometry: Any, path: pathlib.Path) -> Any:
    trimesh = require("trimesh", _EXTRA)
    if geometry.box is not None:
        return trimesh.creation.box(geometry.box.size)
    if geometry.cylinder is not None:
        cylinder = geometry.cylinder
        return trimesh.creation.cylinder(cylinder.radius, cylinder.length, sections=24)
    if geometry.sphere is not None:
        return trimesh.creation.uv_sphere(geometry.sphere.radius, count=(16, 16))
    file = named_file(geometry.mesh.filename, path)
    if file is None:
        raise InputError(path, f"no such mesh {geometry.mesh.filename!r}", REMEDY)
    if file.suffix.lower() not in MESH_SUFFIXES:
        fault = f"not a mesh of type {' '.join(MESH_SUFFIXES)}"
        raise InputError(file, fault, "convert it to STL")
    try:
        loaded = trimesh.load_mesh(file, skip_materials=True, process=False)
        mesh = trimesh.Trimesh(loaded.vertices, loaded.faces, process=False)
        if loaded.units not in (None, "meters"):
            metres = trimesh.units.unit_conversion(loaded.units, "meters")
            mesh.vertices = mesh.vertices * metres
    except Exception as error:  # one parser for each format, each with its own errors
        fault = f"not a readable mesh: {type(error).__name__}"
        raise InputError(file, fault, "export it again as STL") from None
    if len(mesh.faces) == 0 or not np.isfinite(mesh.vertices).all():
        raise InputError(file, "no triangles", "export it again as STL")
    if geometry.mesh.scale is not None:
        mesh.vertices = mesh.vertices * np.broadcast_to(geometry.mesh.scale, 3)
    return mesh
