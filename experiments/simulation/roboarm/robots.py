"""Arms that stand in simulated cells: a robot's linkage, its mount, and its probes."""

import pathlib
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, Float64, Int
from scipy.spatial.transform import Rotation

from experiments.simulation.roboarm.furnishings import to_mesh
from experiments.simulation.roboarm.models import ArmModel, urdf_path
from experiments.simulation.solids import box
from prism_jax.io.errors import InputError
from prism_jax.robots.urdf import REMEDY, Linkage, moves

POINTS_PER_LINK = 80
MAX_TURN = 2.5  # radians to each side of the middle of a joint's range


class Robot(Linkage):
    """An arm: its links' meshes, its joints, and where joint positions put the links.

    `lower` and `upper` are the joints' limits (radians, metres), narrowed to
    `MAX_TURN`. `bodies` has for each link the number of the part that moves as one, 0
    for the root's, and `parents` for each part the one that carries it. Collisions are
    looked for at `probes`, points in the frames of the links `probe_links`, as many on
    every link; `probe_weights` is the share of the surface that each stands for.
    """

    def __init__(self, model: ArmModel):
        self.name, self.spacer = model.name, model.spacer
        self.whole = model.root is None  # all of its file, and not a part
        path, mount = urdf_path(model), np.eye(4)
        mount[:3, :3] = Rotation.from_euler(
            "xyz", model.roll_pitch_yaw, degrees=True
        ).as_matrix()
        tools = {}
        if model.tool_link is not None:
            tools[model.tool_link] = _gripper(model.tool_axis)
        super().__init__(path, model.root, mount, tools)
        limits = np.array([_limits(joint, path) for joint in self.moving])
        self.lower, self.upper = limits.reshape(-1, 2).T
        self._stand_on_the_ground()
        self._number_bodies()
        self._place_probes()
        self.faces_link = np.repeat(
            np.arange(len(self.meshes)), [len(mesh.faces) for mesh in self.meshes]
        )

    def chain_to(self, name: str) -> list[str]:
        """A link with a mesh of each part that moves as one, from the root to the part
        that a frame is on; the link with the largest surface."""
        body, bodies = self._body[name], []
        while body not in bodies:
            bodies.insert(0, body)
            body = self.parents[body]
        areas, chain = np.array([mesh.area for mesh in self.meshes]), []
        for body in bodies:
            links = np.flatnonzero(self.bodies == body)
            if len(links):
                chain.append(self.link_names[links[np.argmax(areas[links])]])
        return chain

    def mesh(self, positions: Float[np.ndarray, " J"]) -> trimesh.Trimesh:
        """All links in one pose: `faces_link` names each face's link."""
        poses = self.link_poses(positions[None])[0]
        placed = [
            mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
            for mesh, pose in zip(self.meshes, poses, strict=True)
        ]
        faces = [mesh.faces for mesh in self.meshes]
        whole = trimesh.util.append_faces(placed, faces)
        return trimesh.Trimesh(*whole, process=False)

    def frame_pose(
        self, name: str, positions: Float[np.ndarray, " J"]
    ) -> Float64[np.ndarray, "4 4"]:
        """Where joint positions put a link's frame, which may have no mesh."""
        return self.frame_poses(positions[None])[0, self.frames.index(name)]

    def probe_points(
        self, positions: Float[np.ndarray, "P J"]
    ) -> Float64[np.ndarray, "P N 3"]:
        """The probes in the robot's frame, for each of the positions."""
        poses = self.link_poses(positions)[:, self.probe_links]
        turned = np.einsum("pnij,nj->pni", poses[..., :3, :3], self.probes)
        return turned + poses[..., :3, 3]

    def _stand_on_the_ground(self) -> None:
        """Lifts the mount so that the first link's lowest point is at the spacer's."""
        pose = self.link_poses(np.clip(0.0, self.lower, self.upper)[None])[0, 0]
        base = self.meshes[0].vertices @ pose[2, :3] + pose[2, 3]
        self.mount[2, 3] = self.spacer - base.min()

    def _number_bodies(self) -> None:
        body, self.parents = {self.frames[0]: 0}, [0]
        for joint in self.chain:
            if joint.child == self.frames[0]:
                continue
            carrier = body[joint.parent]
            if moves(joint):
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
        fault = f"invalid limits of joint {joint.name!r}: {lower:g} to {upper:g}"
        raise InputError(path, fault, REMEDY)
    if joint.type == "prismatic":
        return lower, upper
    middle = (lower + upper) / 2
    return max(lower, middle - MAX_TURN), min(upper, middle + MAX_TURN)


def _gripper(axis: str) -> trimesh.Trimesh:
    """Two fingers on a palm, 0.16 m long, along +x or +z of its link."""
    solids = [box((0, 0, 0.035), (0.07, 0.1, 0.07), 0.008)]
    for side in (-1, 1):
        solids.append(box((0, side * 0.037, 0.115), (0.024, 0.014, 0.09), 0.003))
    mesh = to_mesh(solids)
    if axis == "x":
        mesh.vertices = mesh.vertices[:, [2, 0, 1]]
    return mesh
