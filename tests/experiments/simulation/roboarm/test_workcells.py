import dataclasses

import numpy as np
import pytest

from experiments.simulation.roboarm.mounts import random_mount
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
