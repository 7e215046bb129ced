import dataclasses

import numpy as np
import pytest

from experiments.simulation.roboarm.clutter import are_hidden
from experiments.simulation.roboarm.furnishings import to_mesh, together
from experiments.simulation.roboarm.layouts import HIDDEN
from experiments.simulation.roboarm.mounts import MOUNTS, random_mount
from experiments.simulation.roboarm.workcells import PARTS, make_workcell


@pytest.fixture(scope="module")
def workcells(model):
    model = dataclasses.replace(model, tool_link="lower")
    made = []
    for seed in range(12):
        try:
            made.append(make_workcell(model, 2, np.random.default_rng(seed), (60, 80)))
        except ValueError:
            continue
    assert len(made) >= 8
    return made


@pytest.fixture(scope="module")
def mounts():
    foot = np.array([(-0.1, -0.08), (0.09, 0.1)])
    return [
        (reach, random_mount(reach, foot, spacer, 3, np.random.default_rng(seed)))
        for reach in (0.5, 1.2, 2.8)
        for spacer in (0.0, 0.1)
        for seed in range(12)
    ]


def pieces(mesh):
    return mesh.split(only_watertight=False) if len(mesh.faces) else []


def test_an_arm_stands_on_its_mount(mounts):
    """Something right below its foot ends where the foot is."""
    assert {mount.kind for _, mount in mounts} == set(MOUNTS)
    for _, mount in mounts:
        for base in mount.bases:
            carriage = [s.translate(tuple(base)) for s in mount.carriage]
            solids = [*mount.support, *mount.track, *carriage]
            bounds = np.array([solid.bounding_box() for solid in solids])
            below = bounds[
                np.all(bounds[:, :2] < base[:2], axis=1)
                & np.all(bounds[:, 3:5] > base[:2], axis=1)
            ]
            tops = below[:, 5]
            assert np.min(np.abs(tops - base[2])) < 1e-6
            assert bounds[:, 2].min() > -1e-6


def test_only_a_linear_axis_moves_the_arm(mounts):
    for reach, mount in mounts:
        moves = np.linalg.norm(np.ptp(mount.bases, axis=0))
        assert np.all(mount.bases[0, :2] == 0)
        if mount.kind != "rail":
            assert moves == 0 and not mount.track
            continue
        assert 0 < moves < 3 * reach
        track = to_mesh(mount.track).bounds
        assert np.all(mount.bases[:, :2] > track[0, :2])
        assert np.all(mount.bases[:, :2] < track[1, :2])


def test_the_arm_touches_nothing_that_stands_around(workcells):
    found = set()
    for cell in workcells:
        for number in range(2):
            parts = cell.parts(number)
            assert tuple(parts) == PARTS
            arm = parts["robot"].vertices
            around = ("clutter", "person", "fixture")
            for name in around:
                mesh = cell.fixtures if name == "fixture" else parts[name]
                for piece in pieces(mesh):
                    lower, upper = piece.bounds
                    # A mount's track is right below the arm.
                    if name == "fixture" and cell.mount.kind == "rail":
                        upper = np.minimum(upper, (*upper[:2], cell.mount.bases[0, 2]))
                    inside = np.all((arm > lower) & (arm < upper), axis=1)
                    assert not inside.any()
                    found.add(name)
            assert arm[:, 2].min() > -1e-6
    assert found == {"clutter", "person", "fixture"}


def test_the_camera_has_room_and_sees_the_arm_over_what_is_in_the_way(workcells):
    for cell in workcells:
        eye = np.asarray(cell.camera.position)
        assert eye[2] > 0.3
        middle = (cell.lower + cell.upper) / 2
        assert np.asarray(cell.camera.to_camera(middle[None]))[0, 2] > 0
        for number in range(2):
            for name, part in cell.parts(number).items():
                for piece in pieces(part) if name != "room" else []:
                    outside = np.maximum(piece.bounds[0] - eye, eye - piece.bounds[1])
                    assert outside.max() > 0
            if not len(cell.clutter.faces):
                continue
            bare, whole = (
                are_hidden(mesh, cell.parts(number)["robot"].vertices[None], eye).mean()
                for mesh in (cell.clutter, together([cell.clutter, cell.people]))
            )
            assert bare <= whole < HIDDEN + 0.15


def test_everything_is_on_the_floor_or_on_a_table(workcells):
    for cell in workcells:
        for part in (cell.clutter, cell.people, cell.support):
            if len(part.faces):
                assert -0.01 < part.bounds[0, 2] < 0.05
        heights = {0.0}
        for piece in pieces(cell.support):
            heights.add(round(float(piece.bounds[1, 2]), 5))
        if cell.mount.kind == "rail":
            continue
        for piece in pieces(cell.fixtures):
            low = float(piece.bounds[0, 2])
            assert min(abs(low - height) for height in heights) < 1e-4
