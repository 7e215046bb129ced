import dataclasses

import numpy as np
import trimesh

from experiments.simulation.raycast import Scene
from experiments.simulation.roboarm.furnishings import together
from experiments.simulation.roboarm.sequences import SURVEY, TURNS, survey
from experiments.simulation.sensors import OusterConfig

EXACT = dataclasses.replace(SURVEY.exact(), beams=48, columns=384)


def boxes_scene():
    """A closed box with another inside it, on a table that is not asked for."""
    outer = trimesh.creation.box((0.6, 0.4, 0.5))
    inner = trimesh.creation.box((0.2, 0.2, 0.2))
    top = trimesh.creation.box((1.0, 1.0, 0.1))
    outer.apply_translation((0, 0, 1.0))
    inner.apply_translation((0, 0, 1.0))
    top.apply_translation((0, 0, 0.7))
    whole = together([outer, inner, top])
    return Scene(whole), np.arange(len(whole.faces)) < 24


def test_only_what_is_asked_for_and_seen_from_outside():
    scene, wanted = boxes_scene()
    points = survey(scene, wanted, 3000, np.random.default_rng(0), config=EXACT)
    assert points.shape == (3000, 3)
    scaled = np.abs(points - (0, 0, 1.0)) / (0.3, 0.2, 0.25)
    np.testing.assert_allclose(scaled.max(axis=1), 1, atol=0.006)
    # All sides but the one on the table, each with points up to its edges.
    for axis, half in enumerate((0.3, 0.2, 0.25)):
        for side in (-1, 1):
            off = points[:, axis] - (1.0 if axis == 2 else 0.0)
            face = points[np.abs(off - side * half) < 2e-3]
            if (axis, side) == (2, -1):
                assert len(face) < 0.05 * len(points)
            else:
                spread = np.ptp(face, axis=0) / (0.6, 0.4, 0.5)
                assert np.delete(spread, axis).min() > 0.85


def test_averaged_turns_leave_an_eighth_of_the_noise():
    assert TURNS == 64
    single = np.array(OusterConfig().noise)
    np.testing.assert_allclose(np.array(SURVEY.noise), single * (1, 1 / 8))
    scene, wanted = boxes_scene()
    config = dataclasses.replace(EXACT, noise=SURVEY.noise)
    points = survey(scene, wanted, 4000, np.random.default_rng(0), config=config)
    on_top = points[points[:, 2] > 1.24]
    assert 0.3e-3 < np.std(on_top[:, 2]) < 2.2e-3
