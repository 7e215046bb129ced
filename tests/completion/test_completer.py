"""Scans in any frame and unit, completed by a network of random weights."""

import copy
import dataclasses
import logging

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from scipy.spatial.distance import cdist

from experiments.calibrate import unfitted
from prism_jax.completion.completer import Completer
from prism_jax.completion.options import CompletionOptions
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.visibility import BACKGROUND, SURFACE, UNKNOWN
from prism_jax.geometry.workspace import Workspace
from prism_jax.io.errors import InputError
from prism_jax.preprocessing.sensor import likely_eye
from prism_jax.uncertainty.confidence import EVIDENCE
from prism_jax.uncertainty.evidence import LOOKS
from prism_jax.uncertainty.sigma import CLUES, PointErrors

FAR = np.array([10_000.0, -10_000.0, 500.0])
EYE = np.array([3.0, -2.0, 1.5])
UP = np.array([0.0, 0.0, 1.0])


def scan(count=300, seed=0):
    """Half a box of 1.5 m, in 1024ths of a metre: exact in float32 at 10 km too."""
    rng = np.random.default_rng(seed)
    box = rng.uniform(-1, 1, (count, 3))
    box /= np.abs(box).max(-1, keepdims=True)
    box *= np.sign(box @ EYE)[:, None] * [0.75, 0.5, 0.4]
    return np.round(box * 1024) / 1024


def camera_at(eye):
    """In double precision, as one who measures far from the origin has it."""
    intrinsics = np.array([[100.0, 0, 63.5], [0, 100, 63.5], [0, 0, 1]])
    return Camera(np.eye(3), -np.asarray(eye, np.float64), intrinsics, 128, 128)


@pytest.fixture(scope="module")
def near(completer):
    return completer.complete(scan(), camera_at(EYE))


@pytest.fixture(scope="module", params=[np.float64, np.float32])
def far(completer, request):
    points = (scan() + FAR).astype(request.param)
    return points, completer.complete(points, camera_at(EYE + FAR))


def test_a_scan_far_away_comes_back_in_its_own_frame(far, near, completer):
    points, result = far
    assert result.points.dtype == points.dtype
    assert result.points[result.observed].tobytes() == points.tobytes()
    assert np.array_equal(result.observed, np.arange(len(result.points)) < len(points))
    assert np.array_equal(result.observed, near.observed) and not near.observed.all()
    np.testing.assert_allclose(result.prediction - FAR, near.prediction, atol=1e-8)
    assert result.losses == near.losses
    # Not in the network's float32, which is good for 1 mm there.
    np.testing.assert_allclose(result.camera.position - FAR, EYE, atol=1e-6)
    center = (points.min(0) + points.max(0)) / 2
    np.testing.assert_allclose(result.workspace.center, center, rtol=1e-12)
    half_extent = 0.5 * completer.config.model.margin * np.ptp(points, axis=0).max()
    np.testing.assert_allclose(result.workspace.half_extent, half_extent, rtol=1e-6)
    unit = near.workspace.to_unit(near.points[~near.observed])
    assert np.abs(unit).max() <= 1


def test_added_points_are_of_the_prediction_and_between_them(far, completer):
    points, result = far
    plain = completer.complete(points, camera_at(EYE + FAR), density=0.0)
    added, more = (one.points[~one.observed] for one in (plain, result))
    among = result.prediction.astype(points.dtype)
    assert {tuple(p) for p in added} <= {tuple(p) for p in among}
    assert plain.left_away == result.left_away
    assert 0 < len(added) <= len(among) - max(plain.left_away.values())
    np.testing.assert_array_equal(more[: len(added)], added)
    assert len(more) > len(added)


def test_depth_maps_are_in_user_units(completer):
    """Against a z-buffer of the same points, in NumPy, by the camera that is given."""
    result = completer.complete(scan() + FAR, camera_at(EYE + FAR))
    camera, both = result.camera, result.mask_observed
    for name, cloud in (("observed", scan() + FAR), ("completed", result.points)):
        depth, mask = (getattr(result, f"{what}_{name}") for what in ("depth", "mask"))
        image = (cloud @ camera.rotation.T + camera.translation) @ camera.intrinsics.T
        u, v = np.round(image[:, :2] / image[:, 2:]).astype(int).T
        expected = np.full((128, 128), np.inf)
        inside = (u >= 0) & (u < 128) & (v >= 0) & (v < 128) & (image[:, 2] > 0)
        np.minimum.at(expected, (v[inside], u[inside]), image[inside, 2])
        # A point on the border of two pixels may round to either.
        agree = np.isclose(np.where(mask, depth, np.inf), expected, atol=1e-4)
        assert agree.mean() > 0.999 and mask.sum() > 50
    assert (result.depth_completed[both] <= result.depth_observed[both]).all()
    assert result.mask_completed.sum() > both.sum() == both[result.mask_completed].sum()


def test_another_unit_gives_the_same_in_it(completer, near):
    """Exactly: 1,024 is a power of two."""
    result = completer.complete(1024 * scan(), camera_at(1024 * EYE))
    assert np.array_equal(result.points, 1024 * near.points)
    depth = 1024 * near.depth_completed
    np.testing.assert_allclose(result.depth_completed, depth, rtol=1e-6)
    assert result.losses == near.losses


def test_an_upright_object_is_the_same_in_any_frame(completer, near):
    """The frame is turned so that ``up`` points up, and the result with it."""

    def turned(points):
        x, y, z = np.asarray(points).T
        return np.stack([x, -z, y], axis=-1)

    eye = turned(EYE)
    result = completer.complete(turned(scan()), camera_at(eye), up="-y")
    assert result.losses == near.losses
    np.testing.assert_allclose(result.prediction, turned(near.prediction), atol=1e-12)
    np.testing.assert_allclose(result.points, turned(near.points), atol=1e-12)
    np.testing.assert_allclose(result.depth_observed, near.depth_observed, atol=1e-6)
    np.testing.assert_allclose(result.camera.position, eye, atol=1e-5)


@pytest.fixture(scope="module")
def judging(completer):
    """In three poses. Every completion misses by a tenth of the half side; points do by
    a hundredth near the measured ones, and by a tenth elsewhere."""
    judging = completer.in_poses(LOOKS)
    width = completer.config.model.backbone.global_features[-1]
    blank = unfitted(np.random.default_rng(0).normal(size=(30, width)))
    judging.calibration = dataclasses.replace(
        blank, base=np.log(0.1), fair=0.01, low=0.05
    )
    judging.point_errors = PointErrors(
        base=np.log(0.01),
        looks_at=np.full((1, 1), float(CLUES.index("measured"))),
        thresholds=np.full((1, 1), 0.2),
        leaves=np.array([[0.0, np.log(10.0)]]),
        bounds=np.array([-9.0, 0.0]),
    )
    return judging


@pytest.fixture(scope="module")
def judged(judging):
    return judging.complete(scan(), camera_at(EYE))


def test_a_verdict_is_the_same_in_any_unit_and_place(judging, judged):
    there = judging.complete(1e-3 * (scan() + FAR), camera_at(1e-3 * (EYE + FAR)))
    evidence = judged.verdict.evidence
    assert judged.verdict.trust == "low" and list(evidence) == list(EVIDENCE)
    for result in (judged, there):
        expected = 0.1 * result.workspace.half_extent
        assert result.verdict.expected_error == pytest.approx(expected)
    assert there.verdict.evidence == pytest.approx(evidence, rel=1e-3, abs=1e-4)


def test_without_trees_or_in_one_pose_there_is_neither_verdict_nor_sigma(
    completer, near, judging, judged
):
    mute, alone = copy.copy(judging), copy.copy(completer)
    mute.calibration = mute.point_errors = None
    alone.calibration = judging.calibration
    alone.point_errors = judging.point_errors
    for one, expected in ((mute, judged), (alone, near)):
        result = one.complete(scan(), camera_at(EYE))
        assert result.verdict is None and result.sigma is None
        np.testing.assert_array_equal(result.points, expected.points)


def test_every_added_point_has_its_error_in_the_users_unit(judging, judged):
    assert judged.sigma.shape == judged.observed.shape
    assert (judged.sigma[judged.observed] == 0).all()
    half = judged.workspace.half_extent
    told = judged.sigma[~judged.observed] / half
    plain = judging.complete(scan(), camera_at(EYE), density=0.0)
    added, measured = plain.points[~plain.observed], plain.points[plain.observed]
    far = cdist(added, measured).min(axis=1) / half > 0.2
    assert 0 < far.mean() < 1
    sigma = plain.sigma[~plain.observed] / half
    np.testing.assert_allclose(sigma, np.where(far, 0.1, 0.01), rtol=1e-6)
    # Those between them have what these have, or something between.
    np.testing.assert_allclose(told[: len(added)], sigma, rtol=1e-6)
    assert (told > 0.01 - 1e-9).all() and (told < 0.1 + 1e-9).all()


def test_the_sensor_is_at_the_origin_if_it_can_be(completer):
    """Not from too far away, and not from among the points."""
    away = scan() - 2 * EYE
    there = completer.complete(away)
    given = completer.complete(away, camera_at(np.zeros(3)))
    assert (there.sensor, given.sensor) == ("origin", "given")
    assert np.array_equal(there.prediction, given.prediction)
    np.testing.assert_allclose(there.camera.position, 0, atol=1e-5)
    half = float(there.workspace.half_extent)
    close = scan() - 90 * half * EYE / np.linalg.norm(EYE)
    assert completer.complete(close).sensor == "origin"
    centred = scan() - (scan().min(0) + scan().max(0)) / 2
    assert completer.complete(centred, camera_at(np.zeros(3))).sensor == "given"
    for points in (centred, scan() + FAR):
        result = completer.complete(points)
        assert result.sensor == "unknown"
        likely = likely_eye(points, UP)
        np.testing.assert_allclose(result.camera.position, likely, atol=1e-2)
    moved = completer.complete(scan() + 3 * FAR).prediction - 2 * FAR
    np.testing.assert_allclose(moved, result.prediction, atol=1e-8)


def test_points_outside_the_workspace_are_left_out(completer, near):
    above, aside = np.array([0, 0, 3.0]), np.array([5.0, 0, 0])
    clutter = np.concatenate([scan() + above, scan(), scan() - aside])
    workspace = Workspace(near.workspace.center, near.workspace.half_extent)
    result = completer.complete(clutter, camera_at(EYE), workspace)
    assert result.points.tobytes() == near.points.tobytes()
    assert result.left_out == 2 * len(scan())
    assert result.workspace.half_extent == near.workspace.half_extent
    # And without one, a stray, which at 300 m would make the object a dot.
    strayed = np.concatenate([scan(), [[300.0, -20, 5]]])
    result = completer.complete(strayed, camera_at(EYE))
    assert result.left_out == 1 and result.points.tobytes() == near.points.tobytes()
    of_jax = jax.tree.map(jnp.asarray, workspace)
    single = completer.complete(scan(), camera_at(EYE), of_jax)
    np.testing.assert_allclose(single.prediction, near.prediction, atol=1e-3)
    assert single.prediction.dtype == np.float64


def wall():
    """Points all over the view, far behind the scan."""
    across, up = np.meshgrid(*2 * [np.linspace(-40, 40, 140)])
    right = np.array([EYE[1], -EYE[0], 0]) / np.hypot(*EYE[:2])
    rows = across.reshape(-1, 1) * right + up.reshape(-1, 1) * [0, 0, 1]
    return rows - 5 * EYE


def test_networks_read_surroundings_if_their_configuration_says_so(minimal, reading):
    told = reading.with_model(uses_visibility=True)
    mute = reading.with_model(uses_visibility=False)
    blind = minimal.config.with_model(uses_visibility=True)
    given = scan(), camera_at(EYE)
    for config, count in ((told, 3), (mute, 2), (blind, 2)):
        completer = Completer(config, {})
        alone, task = completer.task(*given), completer.task(*given, around=wall())
        assert alone.visibility is None and len(completer.reads(alone)) == 2
        assert {SURFACE, BACKGROUND} <= set(np.unique(task.visibility.state))
        assert task.visibility.camera.rotation.dtype == np.float32
        np.testing.assert_allclose(
            task.visibility.camera.position, task.read.eye, atol=1e-5
        )
        assert len(completer.reads(task)) == count
        unseen = completer.task(scan() + FAR, around=wall() + FAR)
        assert set(np.unique(unseen.visibility.state)) == {SURFACE, UNKNOWN}


def test_what_lies_outside_a_given_workspace_is_around(completer):
    cube = Workspace(np.zeros(3), np.array(1.2))
    both = np.concatenate([wall()[::2], scan()])
    task = completer.task(both, camera_at(EYE), cube, around=wall()[1::2])
    other = completer.task(scan(), camera_at(EYE), cube, around=wall())
    np.testing.assert_array_equal(task.visibility.state, other.visibility.state)
    assert (task.visibility.state == BACKGROUND).any()


def test_it_adapts_only_if_it_is_asked_to(completer, near):
    result = completer.complete(scan(), camera_at(EYE), adapt=True)
    names = {"objective", "depth_consistency", "normal", "denoise", "align"}
    assert set(result.losses) == names and near.losses == {}
    for values in result.losses.values():
        assert len(values) == completer.config.adapt.num_steps + 1
    task = completer.task(scan(), camera_at(EYE))
    plain, adapted = (
        completer.run(task, CompletionOptions(adapt=adapt))[0]
        for adapt in (False, True)
    )
    np.testing.assert_allclose(plain.points, adapted.before, atol=1e-5)
    assert result.losses["objective"][-1] < result.losses["objective"][0]
    assert result.accepted is True and near.accepted is False
    assert result.weights.sum() == pytest.approx(1)
    assert not np.array_equal(result.prediction, near.prediction)
    assert result.points[result.observed].tobytes() == scan().tobytes()


def test_clouds_of_other_sizes_do_not_compile_again(completer, caplog):
    """Of all sizes up to a power of two, the first alone does."""

    def compiled():
        return [r for r in caplog.records if "ompil" in r.getMessage()]

    completer.complete(scan(600))
    with caplog.at_level(logging.WARNING), jax.log_compiles():
        result = completer.complete(scan(700, seed=1))
        assert not compiled()
        jax.jit(lambda x: x * 3)(np.float32(1))
        assert compiled()
    assert result.seconds["compile"] < 0.1
    assert result.seconds["run"] > 0


def with_one(value):
    return np.where(np.arange(300)[:, None] == 7, value, scan())


CUBE = Workspace(np.zeros(3), np.float64(1e6))
# As it may come out of a pytree, where it is not checked.
NEGATIVE = jax.tree.map(lambda x: -1.0 * x, Workspace.unit())


@pytest.mark.parametrize(
    ("points", "asked", "fault"),
    [
        (np.zeros((0, 3)), {}, "no points"),
        (np.repeat(scan(40), 5, axis=0), {}, "40 distinct points, at least 64"),
        (np.repeat(scan(40), 5, axis=0), {"workspace": CUBE}, "40 distinct points"),
        (np.ones((200, 3)), {}, "zero extent"),
        (with_one(np.nan), {}, "not finite"),
        (with_one(np.inf), {"workspace": CUBE}, "not finite"),
        (2e4 * scan(), {}, "above the limit of 10,000 units"),
        (scan() + 9, {"workspace": Workspace.unit()}, "points inside the workspace"),
        (scan(), {"workspace": NEGATIVE}, "workspace: invalid"),
        (scan(), {"around": with_one(np.nan)}, "around: some points are not finite"),
        (scan(), {"density": np.nan}, "density: invalid value"),
        (scan(), {"up": "north"}, "up=north: no such axis"),
    ],
)
def test_what_cannot_be_completed_is_refused(completer, points, asked, fault):
    with pytest.raises(InputError, match=fault):
        completer.complete(points, **asked)


@pytest.mark.filterwarnings("error")
def test_an_array_of_another_shape_or_type_is_refused(completer, monkeypatch):
    """Where nothing checks types, as in a user's program."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    wrong = [np.ones(shape) for shape in ((100, 4), (3, 100), (300,))]
    wrong += [np.ones((100, 3)).astype(k) for k in (complex, bool, object, "U9")]
    for points in wrong:
        with pytest.raises(InputError, match=r"^points: invalid (shape|type) "):
            completer.complete(points)
