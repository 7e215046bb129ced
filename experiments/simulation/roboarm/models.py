"""Which arms stand in which split's cells, and where their URDF files are.

The files come with the PyPI packages `example-robot-data` and `rtb-data` (the extra
`robots`). An arm that belongs to a larger robot is taken off it at the link `root`.
"""

import dataclasses
import importlib.metadata
import os
import pathlib
import re
import tomllib

from prism_jax.io.errors import InputError, choose

FOLDERS = {"example-robot-data": "robots", "rtb-data": "rtbdata/xacro"}
"""Packages with robots, and the folder that holds them, wherever it lies."""
OWN = "own"  # the family of the user's arms


@dataclasses.dataclass(frozen=True)
class ArmModel:
    """An arm that stands in cells."""

    name: str
    family: str  # its maker's line; none is in two splits
    urdf: str  # URDF or xacro; a relative path is in the package's folder of robots
    # The first link of the arm, which is bolted down by the joint above it; what is not
    # below it is left out. By default the whole robot.
    root: str | None = None
    roll_pitch_yaw: tuple[float, float, float] = (0.0, 0.0, 0.0)  # degrees, of the root
    # Metres between the pedestal and the root's lowest point, for a shoulder whose next
    # link hangs lower.
    spacer: float = 0.0
    # A two-finger gripper is put on this link of an arm without a hand.
    tool_link: str | None = None
    tool_axis: str = "z"  # of that link, along which the gripper points
    licence: str = "its owner's"  # of its meshes
    package: str = "example-robot-data"


def _read() -> dict[str, tuple[ArmModel, ...]]:
    text, arms = pathlib.Path(__file__).with_name("arms.toml").read_text(), {}
    for name, entries in tomllib.loads(text).items():
        for entry in entries:
            if "roll_pitch_yaw" in entry:
                entry["roll_pitch_yaw"] = tuple(entry["roll_pitch_yaw"])
        arms[name] = tuple(ArmModel(**entry) for entry in entries)
    return arms


_READ = _read()
ARMS = {split: _READ[split] for split in ("train", "validation", "test")}
"""The arms of each split; sequence i has arm `i % len`."""
CELL_ARMS = {
    split: ARMS[split] + _READ[f"cells_{split}"] for split in ("train", "validation")
}
"""The arms of the varied cells: those of the same split above, and industrial ones."""


def arms_of(split: str) -> tuple[ArmModel, ...]:
    """The arms of a split; an unknown one raises InputError."""
    return ARMS[choose("split", split, ARMS)]


def own_arm(path: str | os.PathLike) -> ArmModel:
    """An arm of the user's, the whole robot of a URDF file, named after the file."""
    path = pathlib.Path(path).absolute()
    return ArmModel(re.sub(r"[^\w-]", "_", path.stem), OWN, str(path))


def urdf_path(model: ArmModel) -> pathlib.Path:
    """The file of an arm; InputError where it is not there."""
    path = pathlib.Path(model.urdf)
    if not path.is_absolute():
        path = robots_folder(model.package) / path
    if not path.is_file():
        raise InputError(path, "no such file", "check the path")
    return path


def robots_folder(package: str) -> pathlib.Path:
    """Where a package keeps its robots, by its own list of files: nothing of it is
    imported. InputError where it is not installed."""
    remedy = 'install the extra: pip install "prism_jax[robots]"'
    try:
        files = importlib.metadata.files(package) or []
    except importlib.metadata.PackageNotFoundError:
        raise InputError(package, "not installed", remedy) from None
    for file in files:
        before, found, _ = f"/{file.as_posix()}".partition(f"/{FOLDERS[package]}/")
        if file.suffix in (".urdf", ".xacro") and found:
            above = len(file.parts) - len(pathlib.PurePath(before + found).parts)
            path = pathlib.Path(os.path.abspath(file.locate()))
            if path.parents[above].is_dir():
                return path.parents[above]
    raise InputError(package, "no robots in this package", remedy)
