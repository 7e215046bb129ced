"""A folder of models, and which of them an object is."""

import contextlib
import dataclasses
import functools
import hashlib
import io
import pathlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from prism_jax.geometry.visibility import Visibility
from prism_jax.io.atomic import make_output_dir, write_bytes
from prism_jax.io.errors import InputError, StrPath, choose, require
from prism_jax.io.files import default_cache_dir
from prism_jax.registration import evidence
from prism_jax.registration.evidence import Match
from prism_jax.registration.pose import refine, search
from prism_jax.registration.scan import Scan
from prism_jax.registration.surface import Surface, surface_of
from prism_jax.robots.urdf import MESH_SUFFIXES, Linkage, read_mesh

VERSION = 11  # of what is kept in the cache
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
ROBOTS, METRIC = (".urdf", ".xacro"), (".urdf", ".xacro", ".glb")
VERIFIED, POSES = 3, 3  # models that are looked at closely, and poses of each
EQUAL = 0.03  # of the score: two models nearer than this explain an object equally
ALIKE = 0.02  # in longest sides: two surfaces nearer than this are the same
FAR = 8.0  # times as large or as small as an object: perhaps of another unit


@dataclasses.dataclass(frozen=True)
class Model:
    """A model and its name, which is its file's below the folder."""

    name: str
    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    surface: Surface


class Found(NamedTuple):
    """What became of the models of a library, for one object."""

    model: Model | None  # the one that it is
    match: Match | None  # its pose, and what speaks for it
    equal: tuple[str, ...]  # others that look the same and explain it as well
    refused: dict[str, str]  # why it is none of the others, the nearest first

    def told(self) -> dict[str, Any]:
        """What `result.json` says: which model it is and in which pose, what speaks for
        it, and why it is no other."""
        if self.model is None or self.match is None:
            return {"model": None, "refused": self.refused}
        told = {"model": self.model.name, "equal": self.equal, "pose": self.match.pose}
        return {**told, **self.match.evidence._asdict(), "refused": self.refused}

    def placed(self) -> tuple[Float[np.ndarray, "M 3"], Float[np.ndarray, " M"]]:
        """Points of the model's surface in its pose, and the sigma of each."""
        assert self.model is not None and self.match is not None
        return self.match.placed(self.model.surface)


@dataclasses.dataclass(frozen=True, eq=False)
class Library:
    """Models that objects may be, in metres."""

    models: Sequence[Model]

    @functools.cached_property
    def digest(self) -> str:
        """Tells libraries and versions apart: by names and surfaces of models."""
        digest = hashlib.sha256(b"%d" % VERSION)
        for model in self.models:
            digest.update(model.name.encode() + model.surface.points.tobytes())
        return digest.hexdigest()[:16]

    @classmethod
    def from_folder(cls, folder: StrPath, unit: str | None = None) -> "Library":
        """All OBJ, STL, PLY, DAE and GLB files in a folder and below it; where there is
        a URDF or xacro file its links instead. Lengths of the others than URDF, xacro
        and GLB are of this `unit`, one of `UNITS`; without it such a file raises
        InputError, as does one that cannot be read. What is made of a model is kept in
        the cache."""
        require("trimesh", "cad")
        root = pathlib.Path(folder)
        suffixes = *MESH_SUFFIXES, *ROBOTS
        files = sorted(p for p in root.rglob("*") if p.suffix.lower() in suffixes)
        if not files:
            remedy = f"give a folder of {' '.join(suffixes)} files"
            raise InputError(folder, "no such folder, or no models in it", remedy)
        choose("--known_unit", unit or "m", UNITS)
        homes = [file.parent for file in files if file.suffix.lower() in ROBOTS]
        models = []
        for file in files:
            name, kind = file.relative_to(root).as_posix(), file.suffix.lower()
            if kind in ROBOTS:
                robot = Linkage(file)
                for link, mesh in zip(robot.link_names, robot.meshes, strict=True):
                    models.append(prepared(f"{name}:{link}", mesh.vertices, mesh.faces))
                continue
            if any(file.is_relative_to(home) for home in homes):
                continue  # a mesh of a robot's link
            if unit is None and kind not in METRIC:
                remedy = f"set --known_unit to one of {', '.join(UNITS)}"
                raise InputError(file, "the unit of its lengths is not known", remedy)
            vertices, faces = read_mesh(file)
            scale = 1.0 if kind in METRIC or unit is None else UNITS[unit]
            models.append(prepared(name, vertices * scale, faces))
        return cls(models)

    def find(
        self,
        points: Float[np.ndarray, "N 3"],
        eye: Float[np.ndarray, "3"],
        visibility: Visibility | None = None,
        up: Float[np.ndarray, "3"] = np.array([0.0, 0.0, 1.0]),
        before: Found | None = None,
    ) -> Found:
        """The model that one object is, if it is one: of those that could be as large,
        the one whose pose explains the points and what the sensor saw past them.

        All in one frame, in metres. `eye` is where the sensor stood, perhaps by a
        guess; what it saw is the `visibility`, if its place is known. An object may
        stand upright with regard to `up`, or lie anyhow. If it was found `before`, it
        is looked for there first, and elsewhere only if it has gone.
        """
        scan = Scan(np.asarray(points, np.float64), np.asarray(eye), visibility)
        if before is not None and before.model is not None and before.match is not None:
            poses = before.match.poses(scan, before.model.surface)
            here = _best(scan, before.model, poses)
            if not evidence.doubt(here.evidence):
                return before._replace(match=here)
        misfits = {model.name: _misfit(scan, model.surface) for model in self.models}
        fitting = [model for model in self.models if not misfits[model.name]]
        placed = [(model, *search(scan, model.surface, up)) for model in fitting]
        placed.sort(key=lambda one: -one[2])
        sound, refused = [], {}
        for model, poses, _ in placed[:VERIFIED]:
            match = _best(scan, model, poses)
            if reason := evidence.doubt(match.evidence):
                refused[model.name] = reason
            else:
                sound.append((model, match))
        for model, _, _ in placed[VERIFIED:]:
            refused[model.name] = "other models come nearer to the points"
        refused |= {name: reason for name, reason in misfits.items() if reason}
        sound.sort(key=lambda pair: -pair[1].score)
        return _decided(sound, refused)


def _decided(sound: list[tuple[Model, Match]], refused: dict[str, str]) -> Found:
    """The best of those that explain an object, unless another that looks different
    does so as well."""
    if not sound:
        return Found(None, None, (), refused)
    (best, match), *others = sound
    equal, rivals = [], []
    for model, other in others:
        if other.score < match.score - EQUAL:
            refused[model.name] = f"{best.name} explains it better"
        elif _alike(best, match, model, other):
            equal.append(model.name)
        else:
            rivals.append(model.name)
    if not rivals:
        return Found(best, match, tuple(equal), refused)
    tied = [best.name, *equal, *rivals]
    why = dict.fromkeys(tied, f"{' and '.join(tied)} explain it equally well")
    return Found(None, None, (), {**why, **refused})


def _alike(one: Model, match: Match, other: Model, its: Match) -> bool:
    """Whether two models are the same surface where they were found."""
    placed = match.placed(one.surface)[0], its.placed(other.surface)[0]
    near = ALIKE * one.surface.size + np.sqrt(one.surface.area / len(placed[0]))
    both = placed, placed[::-1]
    away = [np.quantile(KDTree(own).query(points)[0], 0.99) for own, points in both]
    return bool(max(away) <= near)


def _misfit(scan: Scan, surface: Surface) -> str | None:
    """Why an object of these widths is none of this model, if it can be told."""
    times = surface.widths[-1] / scan.size
    if not 1 / FAR < times < FAR:
        word = "large" if times > 1 else "small"
        times = 10 ** round(abs(np.log10(times)))
        return f"about {times:,} times too {word}: if all are, check the units"
    slack = 0.05 * surface.size + 6.0 * scan.noise
    middle = len(scan.widths) // 2
    own, its = scan.widths[[middle, -1]], surface.widths[[middle, -1]]
    if (own > its + slack).any():
        return "too small"
    if own[0] < 0.4 * its[0] - slack:
        return "too large"
    return None


def _best(scan: Scan, model: Model, poses: np.ndarray) -> Match:
    """The best of a model's poses, once they are refined."""
    refined = refine(scan, model.surface, poses)[0][:POSES]
    matches = [evidence.match(scan, model.surface, pose) for pose in refined]
    return max(matches, key=lambda match: match.score)


def prepared(
    name: str, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Model:
    """A model by its mesh, in metres; from the cache if it is there and whole."""
    parts = np.asarray(vertices, "<f8"), np.asarray(faces, "<i8")
    digest = hashlib.sha256(b"%d" % VERSION)
    for part in parts:
        digest.update(part.tobytes())
    path = default_cache_dir() / "models" / f"{digest.hexdigest()[:32]}.npz"
    # It may not be there, or damaged in any way.
    with contextlib.suppress(Exception), np.load(path, allow_pickle=False) as kept:
        return Model(name, *parts, Surface(**kept))
    try:
        surface = surface_of(*parts)
    except ValueError as error:
        remedy = "export it again, or take it out of the folder"
        raise InputError(name, str(error), remedy) from None
    content = io.BytesIO()
    np.savez(content, **dataclasses.asdict(surface))
    with contextlib.suppress(InputError):  # a full disk is no fault of the model
        make_output_dir(path.parent)
        write_bytes(path, content.getvalue())
    return Model(name, *parts, surface)
