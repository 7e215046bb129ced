"""Robots read from URDF: the shapes of their links, and where joint positions put them.

The format is the XML robot description of ROS (https://wiki.ros.org/urdf/XML). Files
are parsed, never executed, also those in its macro language (`xacro`), and nothing is
fetched. Lengths are metres, angles radians, and a robot's frame is that of its root
link. The extra `robots` reads the XML and the meshes.
"""

import io
import logging
import pathlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation

from prism_jax.io.errors import InputError, StrPath, require
from prism_jax.io.files import parsing, read_bytes
from prism_jax.robots.xacro import named_file, plain_urdf, robot_xml

MESH_SUFFIXES = (".dae", ".glb", ".obj", ".ply", ".stl")
REMEDY = "fix the URDF, or use another one"
_EXTRA = "robots"
_MOVING = ("revolute", "continuous", "prismatic")
_MAX_ELEMENTS = 10_000  # of a file
# Of a Collada file: nodes of nodes grow exponentially.
_MAX_INSTANCES = {b"instance_node": 16, b"instance_geometry": 2000}
_FAR = 1e9  # numbers beyond it are no metres
_SIZES = {"size": 3, "radius": 1, "length": 1}
_NUMBERS = _SIZES | {"xyz": 3, "rpy": 3, "multiplier": 1, "offset": 1, "scale": 3}
"""How many numbers an attribute has, of those that say where something is."""


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
        trimesh = require("trimesh", _EXTRA)
        path = self.path = pathlib.Path(path)
        robot, self._followed = _parse(path)
        links, self.chain = _subtree(robot, root, path)
        self.moving = [joint for joint in self.chain if moves(joint)]
        self.joints = tuple(joint.name for joint in self.moving)
        self.frames = [link.name for link in links]
        self.mount = np.eye(4) if mount is None else np.array(mount, np.float64)
        self.meshes, self._link_frames = [], []
        for index, link in enumerate(links):
            # What is seen of it, or where the file shows nothing, what may be touched.
            told = link.visuals or link.collisions or []
            shapes = [_shape_mesh(shape, path) for shape in told]
            if tools and link.name in tools:
                shapes.append(tools[link.name])
            if shapes:
                parts = [mesh.vertices for mesh in shapes], [m.faces for m in shapes]
                whole = trimesh.util.append_faces(*parts)
                self.meshes.append(trimesh.Trimesh(*whole, process=False))
                self._link_frames.append(index)
        self.link_names = tuple(self.frames[index] for index in self._link_frames)
        if not self.meshes:
            raise InputError(path, "no link has geometry", REMEDY)

    def link_poses(
        self, positions: Float[np.ndarray, "P J"]
    ) -> Float64[np.ndarray, "P L 4 4"]:
        """Where joint positions put each link: its frame in the robot's."""
        return self.frame_poses(positions)[:, self._link_frames]

    def frame_poses(
        self, positions: Float[np.ndarray, "P J"]
    ) -> Float64[np.ndarray, "P F 4 4"]:
        """The same of all `frames`, those of links without a mesh too."""
        if positions.shape[1:] != (len(self.joints),):
            raise ValueError(f"the robot has {len(self.joints)} joints")
        own = dict(zip(self.joints, positions.T, strict=True))
        poses = {self.frames[0]: np.broadcast_to(self.mount, (len(positions), 4, 4))}
        for joint in self.chain:
            name, factor, offset = self._followed[joint.name]
            followed = own.get(name, np.zeros(len(positions)))
            motion = _motion(joint, followed * factor + offset)
            if joint.child == self.frames[0]:
                poses[joint.child] = poses[joint.child] @ motion
                continue
            origin = np.eye(4) if joint.origin is None else joint.origin
            poses[joint.child] = poses[joint.parent] @ origin @ motion
        return np.stack([poses[name] for name in self.frames], axis=1)


def moves(joint: Any) -> bool:
    """Whether a joint of a file moves on its own."""
    return joint.type in _MOVING and joint.mimic is None


def _parse(path: pathlib.Path) -> tuple[Any, dict[str, tuple[str, float, float]]]:
    """The file's robot, yourdfpy's dataclasses, and what each joint follows."""
    yourdfpy = require("yourdfpy", _EXTRA)
    root = plain_urdf(path) if path.suffix == ".xacro" else robot_xml(path)
    # Its parser raises whatever a malformed file leads to. The public one goes on with
    # what it can make of a file that is no XML.
    with parsing(path, "a valid URDF robot", REMEDY, Exception):
        _check(root)
        robot = yourdfpy.URDF._parse_robot(root)
        joints = {joint.name: joint for joint in robot.joints}
        return robot, {joint.name: _followed(joint, joints) for joint in robot.joints}


def _check(root: ElementTree.Element) -> None:
    """ValueError for what yourdfpy and NumPy would take for something else: names that
    are there twice, unknown joints, one number for three, and what is not finite."""
    if sum(1 for _ in root.iter()) > _MAX_ELEMENTS:
        raise ValueError(f"over {_MAX_ELEMENTS:,} elements")
    for kind in ("link", "joint"):
        names = [part.get("name") for part in root.findall(kind)]
        if len(set(names)) < len(names):
            raise ValueError(f"two of its {kind}s have the same name")
    for joint in root.findall("joint"):
        if joint.get("type") not in (*_MOVING, "fixed"):
            told = f"{joint.get('name')!r} is {joint.get('type')!r}"
            raise ValueError(f"joint {told}, not {', '.join(_MOVING)} or fixed")
    for part in (*root.findall("link"), *root.findall("joint")):
        for element in part.iter():
            _check_numbers(element, part.get("type") in _MOVING)


def _check_numbers(element: ElementTree.Element, moves: bool) -> None:
    for name in _NUMBERS.keys() & element.keys():
        text = element.attrib[name]
        numbers = np.array(text.replace(",", " ").split(), np.float64)
        told = f"<{element.tag} {name}={text[:80]!r}>"
        if len(numbers) != _NUMBERS[name] or not (np.abs(numbers) < _FAR).all():
            raise ValueError(f"{told} is not {_NUMBERS[name]} finite number(s)")
        is_flat = name in _SIZES and not (numbers > 0).all()
        is_still = moves and element.tag == "axis" and np.abs(numbers).max() < 1e-9
        if is_flat or is_still or (name == "scale" and not numbers.all()):
            raise ValueError(f"{told} is zero or negative")


def _followed(joint: Any, joints: Mapping[str, Any]) -> tuple[str, float, float]:
    """The joint whose position this one has, times a factor, plus an offset: itself, or
    at the end of the joints that it mimics."""
    name, factor, offset = joint.name, 1.0, 0.0
    for _ in range(50):
        if joint is None or joint.mimic is None:
            break
        offset += factor * joint.mimic.offset
        factor *= joint.mimic.multiplier
        joint = joints.get(joint.mimic.joint)
    if joint is None or joint.mimic is not None:
        raise ValueError(f"joint {name!r} mimics itself, or no joint")
    return joint.name, factor, offset


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


def _motion(joint: Any, value: Float[np.ndarray, " P"]) -> Float64[np.ndarray, "P 4 4"]:
    """What the joint adds to its origin."""
    motion = np.tile(np.eye(4), (len(value), 1, 1))
    if joint.type not in _MOVING:
        return motion
    along = value[:, None] * joint.axis / np.linalg.norm(joint.axis)
    if joint.type == "prismatic":
        motion[:, :3, 3] = along
    else:
        motion[:, :3, :3] = Rotation.from_rotvec(along).as_matrix()
    return motion


def _shape_mesh(shape: Any, path: pathlib.Path) -> Any:
    trimesh, geometry = require("trimesh", _EXTRA), shape.geometry
    if geometry.box is not None:
        mesh = trimesh.creation.box(geometry.box.size)
    elif geometry.cylinder is not None:
        cylinder = geometry.cylinder
        mesh = trimesh.creation.cylinder(cylinder.radius, cylinder.length, sections=24)
    elif geometry.sphere is not None:
        mesh = trimesh.creation.uv_sphere(geometry.sphere.radius, count=(16, 16))
    else:
        file = named_file(geometry.mesh.filename or "", path)
        if file is None:
            raise InputError(path, f"no such mesh {geometry.mesh.filename!r}", REMEDY)
        vertices, faces = read_mesh(file)
        if geometry.mesh.scale is not None:
            vertices = vertices * geometry.mesh.scale
        mesh = trimesh.Trimesh(vertices, faces, process=False)
    if shape.origin is not None:
        mesh.apply_transform(shape.origin)
    return mesh


@np.errstate(all="ignore")
def read_mesh(file: pathlib.Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices, in metres if the file says its unit, and faces, of one of
    `MESH_SUFFIXES`. InputError for what is no such mesh."""
    trimesh, kind = require("trimesh", _EXTRA), file.suffix.lower()
    if kind not in MESH_SUFFIXES:
        fault = f"not a mesh of type {' '.join(MESH_SUFFIXES)}"
        raise InputError(file, fault, "convert it to STL")
    data = read_bytes(file)
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)  # a fault is told here
    options = {"skip_materials": True, "process": False, "file_type": kind[1:]}
    # One parser for each format, each with its own errors.
    with parsing(file, "a readable mesh", "export it again as STL", Exception):
        if any(data.count(name) > most for name, most in _MAX_INSTANCES.items()):
            raise ValueError("too many instances")
        loaded = trimesh.load_mesh(io.BytesIO(data), **options)
        vertices, faces = np.array(loaded.vertices), np.array(loaded.faces)
        if loaded.units not in (None, "meters"):
            vertices *= trimesh.units.unit_conversion(loaded.units, "meters")
        is_whole = 0 <= faces.min() <= faces.max() < len(vertices)
        if not is_whole or not (np.abs(vertices) < _FAR).all() or vertices.shape[1] < 3:
            raise ValueError("a corner is not finite, or missing")
    return vertices, faces
