"""Scans in any frame and unit, completed by a network of random weights."""

import dataclasses
import logging
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from experiments.calibrate import unfitted
from prism_jax.adaptation.test_time import Completion
from prism_jax.completion.completer import CompletedScan, Completer, _checked, _in_slots
from prism_jax.completion.filtering import mask_unobserved
from prism_jax.completion.weights import save_weights
from prism_jax.geometry.camera import Camera
from prism_jax.geometry.visibility import (
    BACKGROUND,
    NEARER,
    SURFACE,
    UNKNOWN,
    nothing_known,
)
from prism_jax.geometry.workspace import Workspace
from prism_jax.io.errors import InputError
from prism_jax.preprocessing.segmentation.scene import SegmentedScene
from prism_jax.preprocessing.sensor import likely_eye
from prism_jax.uncertainty.confidence import EVIDENCE
from prism_jax.uncertainty.evidence import LOOKS
from prism_jax.uncertainty.sigma import CLUES, PointErrors

FAR = np.array([10_000.0, -10_000.0, 500.0])
EYE = np.array([3.0, -2.0, 1.5])


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


class Adapting(Completer):
    """It adapts unless it is told not to: what holds with steps does so without."""

    def complete(self, *given, adapt=True, **asked):
        return super().complete(*given, adapt=adapt, **asked)


@pytest.fixture(scope="module")
def completer(minimal, minimal_variables):
    return Adapting(minimal.config, minimal_variables)


@pytest.fixture(scope="module")
def near(completer):
    return completer.complete(scan(), camera_at(EYE))


@pytest.fixture(scope="module", params=[np.float64, np.float32])
def far(completer, request):
    points = (scan() + FAR).astype(request.param)
    assert np.array_equal(points, scan() + FAR)
    return points, completer.complete(points, camera_at(EYE + FAR))


def test_measured_points_come_back_as_given(far):
    points, result = far
    assert result.points.dtype == points.dtype
    assert result.points[result.observed].tobytes() == points.tobytes()
    assert np.array_equal(result.observed, np.arange(len(result.points)) < len(points))
    assert (~result.observed).any()


def test_added_points_are_of_the_prediction_and_between_them(far, completer):
    points, result = far
    plain = completer.complete(points, camera_at(EYE + FAR), density=0.0)
    added = plain.points[~plain.observed]
    among = result.prediction.astype(points.dtype)
    assert {tuple(p) for p in added} <= {tuple(p) for p in among}
    assert plain.left_away == result.left_away
    kept = len(among) - max(plain.left_away.values())
    assert 0 < len(added) <= kept
    more = result.points[~result.observed]
    np.testing.assert_array_equal(more[: len(added)], added)
    assert np.isfinite(result.points).all() and len(more) > len(added)


@pytest.fixture(scope="module")
def posed(minimal, minimal_variables):
    """In the poses that a verdict compares."""
    return Adapting(minimal.config.with_model(poses=LOOKS), minimal_variables)


@pytest.fixture(scope="module")
def judging(posed, minimal):
    """The same with a calibration by which every error is a tenth of the half side."""
    width = minimal.model.backbone.global_features[-1]
    features = np.random.default_rng(0).normal(size=(30, width))
    blank = unfitted(features)
    calibration = dataclasses.replace(blank, base=np.log(0.1), fair=0.01, low=0.05)
    judging = Adapting(posed.config, posed.variables, calibration=calibration)
    judging._compiled = posed._compiled
    return judging


def test_without_a_calibration_there_is_no_verdict(posed, judging):
    near = posed.complete(scan(), camera_at(EYE))
    assert near.verdict is None
    result = judging.complete(scan(), camera_at(EYE))
    assert result.verdict.trust == "low"
    assert list(result.verdict.evidence) == list(EVIDENCE)
    expected = 0.1 * result.workspace.half_extent
    assert result.verdict.expected_error == pytest.approx(expected)
    np.testing.assert_array_equal(result.points, near.points)


def test_in_too_few_poses_there_is_neither_verdict_nor_sigma(
    completer, near, judging, telling
):
    judges = judging.calibration, telling.point_errors
    alone = Adapting(completer.config, completer.variables, None, *judges)
    alone._compiled = completer._compiled
    result = alone.complete(scan(), camera_at(EYE))
    assert result.verdict is None and result.sigma is None
    np.testing.assert_array_equal(result.points, near.points)


def test_a_verdict_is_the_same_in_any_unit_and_place(judging):
    here = judging.complete(scan(), camera_at(EYE)).verdict
    there = judging.complete(1e-3 * (scan() + FAR), camera_at(1e-3 * (EYE + FAR)))
    assert there.verdict.expected_error == pytest.approx(1e-3 * here.expected_error)
    for name, value in here.evidence.items():
        assert there.verdict.evidence[name] == pytest.approx(value, rel=1e-3, abs=1e-4)


@pytest.fixture(scope="module")
def telling(judging):
    """One that expects a hundredth of the half side near the measured points, and a
    tenth elsewhere."""
    point_errors = PointErrors(
        base=np.log(0.01),
        looks_at=np.full((1, 1), float(CLUES.index("measured"))),
        thresholds=np.full((1, 1), 0.2),
        leaves=np.array([[0.0, np.log(10.0)]]),
        bounds=np.array([-9.0, 0.0]),
    )
    telling = Adapting(judging.config, judging.variables, point_errors=point_errors)
    telling._compiled = judging._compiled
    return telling


def test_every_added_point_has_its_error_in_the_users_unit(posed, judging, telling):
    near = posed.complete(scan(), camera_at(EYE))
    assert near.sigma is None and judging.complete(scan()).sigma is None
    result = telling.complete(scan(), camera_at(EYE))
    np.testing.assert_array_equal(result.points, near.points)
    assert result.verdict is None and result.sigma.shape == result.observed.shape
    assert (result.sigma[result.observed] == 0).all()
    told = result.sigma[~result.observed] / result.workspace.half_extent
    plain = telling.complete(scan(), camera_at(EYE), density=0.0)
    sigma = plain.sigma[~plain.observed] / plain.workspace.half_extent
    added, measured = plain.points[~plain.observed], plain.points[plain.observed]
    apart = np.linalg.norm(added[:, None] - measured, axis=-1).min(axis=1)
    far = apart / plain.workspace.half_extent > 0.2
    assert 0 < far.mean() < 1
    np.testing.assert_allclose(sigma, np.where(far, 0.1, 0.01), rtol=1e-6)
    # Those between them have what these have, or something between.
    np.testing.assert_allclose(told[: len(added)], sigma, rtol=1e-6)
    assert (told > 0.01 - 1e-9).all() and (told < 0.1 + 1e-9).all()


def test_errors_are_the_same_in_any_unit_and_place(telling):
    here = telling.complete(scan(), camera_at(EYE), density=0.0)
    away = 1e-3 * (scan() + FAR)
    there = telling.complete(away, camera_at(1e-3 * (EYE + FAR)), density=0.0)
    assert len(there.sigma) == len(here.sigma)
    differ = ~np.isclose(1e3 * there.sigma, here.sigma, rtol=1e-3)
    assert differ.mean() < 0.01  # on the other side of the threshold
    again = telling.complete(scan(), camera_at(EYE), density=0.0)
    assert again.sigma.tobytes() == here.sigma.tobytes()


@pytest.mark.parametrize("density", [-1.0, np.nan, np.inf])
def test_a_density_that_is_none_is_refused(completer, density):
    with pytest.raises(InputError, match="density: invalid value"):
        completer.complete(scan(), density=density)


def test_nothing_is_added_outside_the_workspace(near):
    unit = near.workspace.to_unit(near.points[~near.observed])
    assert np.abs(unit).max() <= 1


def test_the_workspace_is_the_users(far, minimal):
    points, result = far
    center = (points.min(0) + points.max(0)) / 2
    half_extent = 0.5 * minimal.model.margin * np.ptp(points, axis=0).max()
    np.testing.assert_allclose(result.workspace.center, center, rtol=1e-12)
    np.testing.assert_allclose(result.workspace.half_extent, half_extent, rtol=1e-6)
    away = np.abs(result.prediction - result.workspace.center)
    assert away.max() <= result.workspace.half_extent * (1 + 1e-6)


def test_the_camera_is_the_users(far):
    """Not in the float32 of the network, which at 10 km is good for 1 mm."""
    _, result = far
    np.testing.assert_allclose(result.camera.position - FAR, EYE, atol=1e-6)


def test_depth_maps_are_in_user_units(far):
    """Against a z-buffer of the same points, in NumPy, by the camera that is given."""
    points, result = far
    camera = result.camera
    clouds = {"observed": points}
    if points.dtype == np.float64:
        # In float32 added points are rounded to 1 mm here, after the map was made.
        clouds["completed"] = result.points
    for name, cloud in clouds.items():
        depth = getattr(result, f"depth_{name}")
        mask = getattr(result, f"mask_{name}")
        x, y, z = camera.rotation @ cloud.T + camera.translation[:, None]
        fx, fy = camera.intrinsics[0, 0], camera.intrinsics[1, 1]
        u = np.round(fx * x / z + camera.intrinsics[0, 2]).astype(int)
        v = np.round(fy * y / z + camera.intrinsics[1, 2]).astype(int)
        expected = np.full((128, 128), np.inf)
        inside = (u >= 0) & (u < 128) & (v >= 0) & (v < 128) & (z > 0)
        np.minimum.at(expected, (v[inside], u[inside]), z[inside])
        # A point on the border of two pixels may round to either.
        agree = np.isclose(np.where(mask, depth, np.inf), expected, atol=1e-4)
        assert agree.mean() > 0.999
        assert mask.sum() > 50


def test_what_is_added_hides_and_never_uncovers(near):
    assert (near.mask_completed >= near.mask_observed).all()
    both = near.mask_observed
    assert (near.depth_completed[both] <= near.depth_observed[both]).all()
    assert near.mask_completed.sum() > near.mask_observed.sum()


def test_float32_and_float64_give_the_same(completer):
    points = scan() + FAR
    double = completer.complete(points)
    single = completer.complete(points.astype(np.float32))
    assert np.array_equal(single.prediction, double.prediction)
    assert np.array_equal(single.observed, double.observed)


def test_another_frame_gives_the_same_there(near, far):
    _, result = far
    np.testing.assert_allclose(result.prediction - FAR, near.prediction, atol=1e-8)
    assert np.array_equal(result.observed, near.observed)
    assert result.losses == near.losses
    np.testing.assert_allclose(result.depth_completed, near.depth_completed, atol=1e-5)


def test_another_unit_gives_the_same_in_it(completer, near):
    """Exactly: 1,024 is a power of two."""
    result = completer.complete(1024 * scan(), camera_at(1024 * EYE))
    assert np.array_equal(result.prediction, 1024 * near.prediction)
    assert np.array_equal(result.points, 1024 * near.points)
    np.testing.assert_allclose(
        result.depth_completed, 1024 * near.depth_completed, rtol=1e-6
    )
    assert result.losses == near.losses


def test_two_runs_are_bitwise_equal(completer, near):
    again = completer.complete(scan(), camera_at(EYE))
    for field in dataclasses.fields(CompletedScan):
        if field.name != "seconds":
            a, b = getattr(again, field.name), getattr(near, field.name)
            leaves = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
            assert all(np.array_equal(x, y) for x, y in leaves), field.name


TURNS = {
    "z": lambda x, y, z: (x, y, z),
    "-z": lambda x, y, z: (x, -y, -z),
    "y": lambda x, y, z: (x, z, -y),
    "-y": lambda x, y, z: (x, -z, y),
    "x": lambda x, y, z: (z, y, -x),
    "-x": lambda x, y, z: (-z, y, x),
}


@pytest.mark.parametrize("up", TURNS)
def test_an_upright_object_is_the_same_in_any_frame(completer, near, up):
    """The frame is turned so that ``up`` points up, and the result with it."""

    def turned(points):
        return np.stack(TURNS[up](*np.asarray(points).T), -1)

    top = turned(np.array([[0.0, 0, 1]]))[0]
    axis = {"x": 0, "y": 1, "z": 2}[up[-1]]
    assert top[axis] == (-1 if up[0] == "-" else 1)
    result = completer.complete(turned(scan()), camera_at(turned(EYE[None])[0]), up=up)
    assert result.losses == near.losses
    np.testing.assert_allclose(result.prediction, turned(near.prediction), atol=1e-12)
    np.testing.assert_allclose(result.points, turned(near.points), atol=1e-12)
    np.testing.assert_allclose(result.depth_observed, near.depth_observed, atol=1e-6)
    position = np.asarray(result.camera.position)
    np.testing.assert_allclose(position, turned(EYE[None])[0], atol=1e-5)


def test_without_a_camera_the_sensor_is_at_the_origin(completer):
    away = scan() - 2 * EYE
    there = completer.complete(away)
    given = completer.complete(away, camera_at(np.zeros(3)))
    assert np.array_equal(there.prediction, given.prediction)
    np.testing.assert_allclose(there.camera.position, 0, atol=1e-5)


def test_an_origin_too_far_away_is_no_sensor(completer, near):
    """Seen from the same side whatever the map's origin, and not from there."""
    half = float(near.workspace.half_extent)
    assert np.linalg.norm(FAR) > 100 * half
    results = [completer.complete(scan() + offset) for offset in (FAR, 3 * FAR)]
    for result, offset in zip(results, (FAR, 3 * FAR), strict=True):
        assert result.sensor == "unknown"
        position = result.camera.position
        likely = likely_eye(scan() + offset, np.array([0, 0, 1.0]))
        np.testing.assert_allclose(position, likely, atol=1e-2)
        prediction = result.prediction - offset
        np.testing.assert_allclose(prediction, results[0].prediction - FAR, atol=1e-8)
    close = completer.complete(scan() - 90 * half * EYE / np.linalg.norm(EYE))
    assert (near.sensor, close.sensor) == ("given", "origin")
    np.testing.assert_allclose(close.camera.position, 0, atol=1e-4)


def test_an_origin_among_the_points_is_no_sensor(completer):
    """From there most of a centred cloud would be out of view."""
    points = scan()
    middle = (points.min(0) + points.max(0)) / 2
    result = completer.complete(points - middle)
    assert result.sensor == "unknown"
    likely = likely_eye(points - middle, np.array([0, 0, 1.0]))
    np.testing.assert_allclose(result.camera.position, likely, atol=1e-5)
    given = completer.complete(points - middle, camera_at(np.zeros(3)))
    assert given.sensor == "given"


def test_an_unknown_sensor_turns_with_the_scan(minimal, minimal_variables):
    """The same completion, turned about the vertical, and seen from the same side."""
    model = dataclasses.replace(minimal.config.model, heading="level")
    config = dataclasses.replace(minimal.config, model=model)
    completer = Completer(config, minimal_variables)
    points = scan() - (scan().min(0) + scan().max(0)) / 2
    results = []
    for degrees in (0, 45, 180):
        turn = Rotation.from_euler("z", degrees, degrees=True)
        result = completer.complete(turn.apply(points))
        assert result.sensor == "unknown"
        results.append(
            [
                turn.inv().apply(cloud)
                for cloud in (result.camera.position[None], result.prediction)
            ]
        )
    for eye, prediction in results[1:]:
        np.testing.assert_allclose(eye, results[0][0], atol=1e-5)
        np.testing.assert_allclose(prediction, results[0][1], atol=1e-3)


def test_points_outside_the_workspace_are_left_out(completer, near):
    above, aside = np.array([0, 0, 3.0]), np.array([5.0, 0, 0])
    clutter = np.concatenate([scan() + above, scan(), scan() - aside])
    workspace = Workspace(near.workspace.center, near.workspace.half_extent)
    result = completer.complete(clutter, camera_at(EYE), workspace)
    assert result.points.tobytes() == near.points.tobytes()
    assert result.left_out == 2 * len(scan())
    assert result.workspace.half_extent == near.workspace.half_extent
    assert np.array_equal(result.prediction, near.prediction)


def test_a_few_stray_points_change_nothing_and_are_counted(completer):
    """Five at 300 m would make the object a dot."""
    points = scan(948) + np.array([4.0, 1.0, 0.0])
    strays = np.array([300.0, -20, 5]) + scan(5, seed=1)
    alone = completer.complete(points)
    result = completer.complete(np.concatenate([strays, points]))
    assert (alone.left_out, result.left_out) == (0, 5)
    assert result.points.tobytes() == alone.points.tobytes()
    assert np.array_equal(result.observed, alone.observed)
    assert result.losses == alone.losses


def wall():
    """Points all over the view, far behind the scan."""
    across, up = np.meshgrid(*2 * [np.linspace(-40, 40, 140)])
    right = np.array([EYE[1], -EYE[0], 0]) / np.hypot(*EYE[:2])
    rows = across.reshape(-1, 1) * right + up.reshape(-1, 1) * [0, 0, 1]
    return rows - 5 * EYE


@pytest.mark.parametrize("told", [True, False])
@pytest.mark.parametrize("reads", [True, False])
def test_networks_are_told_of_surroundings_if_their_configuration_says_so(
    minimal, told, reads
):
    backbone = dataclasses.replace(
        minimal.config.model.backbone, reads_visibility=reads
    )
    model = dataclasses.replace(
        minimal.config.model, backbone=backbone, uses_visibility=told
    )
    completer = Completer(dataclasses.replace(minimal.config, model=model), {})
    given = scan(), camera_at(EYE)
    alone, task = completer.task(*given), completer.task(*given, around=wall())
    assert alone.known is None and len(completer.reads(alone)) == 2
    assert {SURFACE, BACKGROUND} <= set(np.unique(task.known.state))
    assert task.known.camera.rotation.dtype == np.float32
    np.testing.assert_allclose(task.known.camera.position, task.read.eye, atol=1e-5)
    expected = 3 if told and reads else 2
    assert len(completer.reads(task)) == expected
    origin = completer.task(scan() + FAR, around=wall() + FAR)
    assert set(np.unique(origin.known.state)) == {SURFACE, UNKNOWN}  # no sensor


def test_what_lies_outside_a_given_workspace_is_around(minimal):
    completer = Completer(minimal.config, {})
    cube = Workspace(np.zeros(3), np.array(1.2))
    both = np.concatenate([wall()[::2], scan()])
    task = completer.task(both, camera_at(EYE), cube, around=wall()[1::2])
    other = completer.task(scan(), camera_at(EYE), cube, around=wall())
    np.testing.assert_array_equal(task.known.state, other.known.state)
    assert (task.known.state == BACKGROUND).any()


def test_around_an_object_of_a_scene_lies_all_that_is_not_its_own(minimal, monkeypatch):
    tasks = []

    def stop(self, batch, options):
        tasks.extend(batch)
        raise StopIteration

    monkeypatch.setattr(Completer, "_run_together", stop)
    points = np.concatenate([scan(), scan() - 2 * EYE, wall()[::2]])
    number = np.repeat([0, 1, -1], [300, 300, len(wall()[::2])])
    scene = SegmentedScene(number, (), (300, 300), len(wall()[::2]), 0)
    completer = Completer(minimal.config, {})
    with pytest.raises(StopIteration):
        completer.complete_scene(
            points, camera_at(EYE), up="z", scene=scene, around=wall()[1::2]
        )
    assert len(tasks) == 2
    # The nearer one hides some of the cube of the one behind it.
    assert {*np.unique(tasks[1].known.state)} >= {SURFACE, NEARER, BACKGROUND}
    assert (tasks[0].known.state == BACKGROUND).any()


def test_maps_of_several_objects_go_into_their_slots():
    def adapt(variables, partial, view, known=None):
        away = partial + variables["by"]
        return Completion(away, known.depth, away.sum() > 0, {}, away, {}, away)

    reads = np.arange(6.0).reshape(3, 2), {}, nothing_known(4)
    stacked = jax.tree.map(lambda leaf: np.stack([leaf] * 3), reads[2])
    used = np.array([True, True, False])
    found = jax.jit(_in_slots(adapt))({"by": 1.0}, (reads[0], {}, stacked), used)
    np.testing.assert_array_equal(found.points, [[1, 2], [3, 4], [0, 0]])
    assert found.before.shape == (3, 4, 4)


def test_what_lies_around_is_checked_as_points_are(completer):
    around = np.where(np.arange(5)[:, None] == 3, np.nan, np.zeros((5, 3)))
    with pytest.raises(InputError, match=r"around: some points are not finite"):
        completer.complete(scan(), camera_at(EYE), around=around)


def test_a_workspace_of_jax_arrays_will_do(completer, near):
    workspace = jax.tree.map(jnp.asarray, near.workspace)
    result = completer.complete(scan(), camera_at(EYE), workspace)
    np.testing.assert_allclose(result.prediction, near.prediction, atol=1e-3)
    assert result.prediction.dtype == np.float64


def test_losses_before_each_step_and_after_the_last(near, minimal):
    names = {"objective", "depth_consistency", "normal", "denoise", "align"}
    assert set(near.losses) == names
    for values in near.losses.values():
        assert len(values) == minimal.config.adapt.num_steps + 1
        assert np.isfinite(values).all()
    assert near.losses["objective"][-1] < near.losses["objective"][0]
    assert near.accepted is True
    assert near.weights.sum() == pytest.approx(1)


def test_nothing_adapts_unless_it_is_asked_to(minimal, minimal_variables, near):
    completer = Completer(minimal.config, minimal_variables)
    result = completer.complete(scan(), camera_at(EYE))
    assert result.accepted is False
    assert all(len(values) == 1 for values in result.losses.values())
    first = {name: values[:1] for name, values in near.losses.items()}
    for name, values in result.losses.items():
        np.testing.assert_allclose(values, first[name], rtol=1e-4)
    assert not np.array_equal(result.prediction, near.prediction)
    assert result.points[result.observed].tobytes() == scan().tobytes()


def test_clouds_of_other_sizes_do_not_compile_again(completer, caplog):
    """Of all sizes up to a power of two, the first alone does."""
    completer.complete(scan(600))
    with caplog.at_level(logging.WARNING), jax.log_compiles():
        result = completer.complete(scan(700, seed=1))
    messages = [record.getMessage() for record in caplog.records]
    assert not [text for text in messages if "ompil" in text]
    assert result.seconds["compile"] < 0.1
    assert result.seconds["run"] > 0


def test_compilations_would_have_been_seen(caplog):
    with caplog.at_level(logging.WARNING), jax.log_compiles():
        jax.jit(lambda x: x * 3)(np.float32(1))
    assert any("ompil" in record.getMessage() for record in caplog.records)


@pytest.mark.parametrize(
    ("points", "fault"),
    [
        (np.zeros((0, 3)), "no points"),
        (scan(63), "63 distinct points, at least 64"),
        (np.repeat(scan(40), 5, axis=0), "40 distinct points, at least 64"),
        (np.ones((200, 3)), "zero extent"),
        (np.where(np.arange(300)[:, None] == 7, np.nan, scan()), "not finite"),
        (np.where(np.arange(300)[:, None] == 7, np.inf, scan()), "not finite"),
        (2e4 * scan(), "above the limit of 10,000 units"),
    ],
)
@pytest.mark.parametrize("framed", [False, True])
def test_points_that_cannot_be_completed(completer, points, fault, framed):
    workspace = Workspace(np.zeros(3), np.float64(1e6)) if framed else None
    with pytest.raises(InputError, match=fault):
        completer.complete(points, workspace=workspace)


def test_a_workspace_with_too_few_points(completer):
    nowhere = Workspace(np.array([9.0, 9, 9]), np.float64(1.0))
    with pytest.raises(InputError, match="points inside the workspace"):
        completer.complete(scan(), workspace=nowhere)
    corner = Workspace(scan()[0], np.float64(0.2))
    with pytest.raises(InputError, match="distinct points, at least 64 are needed; "):
        completer.complete(scan(), workspace=corner)


@pytest.mark.parametrize("half_extent", [-1.0, 0.0, np.nan])
def test_a_workspace_without_volume(completer, half_extent):
    """As it may come out of a pytree, where it is not checked."""
    workspace = jax.tree.map(lambda x: x * half_extent, Workspace.unit())
    with pytest.raises(InputError, match="workspace: invalid"):
        completer.complete(scan(), workspace=workspace)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", [complex, bool, object, "U9"])
def test_an_array_of_no_real_numbers(kind):
    with pytest.raises(InputError, match=r"points: invalid type .*real coordinates"):
        _checked(scan().astype(kind))


def test_an_array_of_another_shape():
    """Where nothing checks types, as in a user's program."""
    code = (
        "import numpy as np\n"
        "from prism_jax.completion.completer import Completer\n"
        "from prism_jax.io import InputError\n"
        "for shape in [(100, 4), (3, 100), (10, 10, 3), (300,)]:\n"
        "    try:\n"
        "        Completer(None, None).complete(np.ones(shape))\n"
        "    except InputError as error:\n"
        "        print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    lines = done.stdout.splitlines()
    assert len(lines) == 4
    assert lines[0] == (
        "points: invalid shape (100, 4); pass an (N, 3) array, such as points[:, :3]"
    )


def test_an_unknown_axis(completer):
    with pytest.raises(InputError, match="up=north: no such axis"):
        completer.complete(scan(), up="north")


def test_released_weights_by_file(tmp_path, tiny, tiny_variables):
    save_weights(tmp_path / "w.safetensors", tiny, tiny_variables, {})
    loaded = Completer.from_pretrained(str(tmp_path / "w.safetensors"))
    assert loaded.config == tiny
    with pytest.raises(InputError, match="no such weights"):
        Completer.from_pretrained("nothing")


def test_what_was_measured_already_is_not_added():
    """On a grid of spacing 1, nothing within half of that of a measured point."""
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(*3 * [np.arange(5.0)]), -1).reshape(-1, 3)
    prediction = rng.uniform(-2, 6, (200, 3))
    apart = np.linalg.norm(prediction[:, None] - grid[None], axis=-1).min(1)
    repeated = np.concatenate([grid, grid[:40]])
    kept = mask_unobserved(prediction, grid, repeated, spacing=0.5)
    assert np.array_equal(kept, apart > 0.5)
    assert kept.any()
    assert not kept.all()
    assert not mask_unobserved(grid, grid, repeated).any()
