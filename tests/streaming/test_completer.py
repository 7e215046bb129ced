"""Frames are completed as scans are."""

import numpy as np
import pytest
import trimesh

from prism_jax.completion import filtering
from prism_jax.completion.completer import Completer
from prism_jax.envelope.robot import of_robot, robot_surface
from prism_jax.geometry.camera import Camera
from prism_jax.io.errors import InputError
from prism_jax.io.ply import KNOWN, OBSERVED
from prism_jax.io.scan import parse_bounds, read_scan
from prism_jax.io.streams import Frame
from prism_jax.preprocessing import observation
from prism_jax.registration.library import Library, Model
from prism_jax.registration.surface import surface_of
from prism_jax.robots.urdf import Linkage
from prism_jax.streaming.completer import FrameCompleter
from tests.experiments.simulation.roboarm.conftest import urdf

__all__ = ["urdf"]

RNG = np.random.default_rng(0)


def counted(points, **about):
    """A frame of points, each with its row."""
    return Frame(points, 7, fields={"row": np.arange(len(points))}, **about)


def shell(number, scalar=np.float32):
    """What is seen from the origin of a box in front of it."""
    points = RNG.uniform([3, -1, -0.5], [4, 1, 0.5], (300 + 40 * number, 3))
    points[::2, 0] = 3.0
    return points.astype(scalar)


@pytest.mark.parametrize("scalar", [np.float32, np.float64])
@pytest.mark.parametrize("adapt", [False, True])
def test_a_frame_is_what_a_scan_is_bit_for_bit(completer, scalar, adapt):
    camera = Camera.look_at((0, 0, 1.0), (3.5, 0, 0))
    asked = {"adapt": adapt, "up": "-y", "density": 2.0 * adapt}
    stream = FrameCompleter(completer, **asked)
    for number, view in enumerate((None, camera)):
        stray = np.full((1, 3), 300.0, scalar)
        points = np.concatenate([stray, shell(number, scalar)])
        done = stream.complete(counted(points, camera=view))
        np.testing.assert_array_equal(done.fields["row"], np.arange(1, len(points)))
        whole = completer.complete(points, view, **asked)
        np.testing.assert_array_equal(done.points, whole.points)
        np.testing.assert_array_equal(done.observed, whole.observed)
        assert done.points.dtype == scalar and done.timestamp == 7
        assert done.workspace.half_extent == whole.workspace.half_extent
        assert set(done.seconds) == {"observe", "network", "assemble"}


def test_up_of_a_cloud_in_an_optical_frame_is_that_of_its_camera(completer):
    for name, camera, up in [
        ("lidar", None, "z"),
        ("cam_optical_frame", None, "-y"),
        ("cam_optical_frame", Camera.look_at((0, 0, 1.0), (3.5, 0, 0)), "-y"),
    ]:
        frame = Frame(shell(0), 0, camera, frame_id=name)
        assert FrameCompleter(completer).observe(frame).up == up
    done = FrameCompleter(completer).complete(frame)
    assert done.frame_id == "cam_optical_frame"


def test_poses_are_a_streams_own(completer, monkeypatch):
    """One is what it takes if nothing is said, whatever the weights say."""
    three, asked = completer.in_poses(3), []
    monkeypatch.setattr(Completer, "in_poses", lambda one, count: asked.append(count))
    FrameCompleter(three)
    FrameCompleter(completer, poses=2)
    FrameCompleter(three, poses=3)
    assert asked == [1, 2]


def test_what_bounds_crop_away_is_around_a_frame_as_around_a_scan(
    completer, tmp_path, monkeypatch
):
    """A wall behind the object: both leave away what they see before it. The few points
    that this network reads would make a rim as wide as the workspace."""
    monkeypatch.setattr(filtering, "PAST", 0.5)
    across, up = (axis.ravel() for axis in np.meshgrid(*2 * [np.linspace(-9, 9, 300)]))
    wall = np.stack([np.full(across.shape, 9.0), across, up], axis=1)
    points = np.concatenate([wall, shell(0)]).astype(np.float32)
    np.save(tmp_path / "scan.npy", points)
    box = parse_bounds("2,-2,-1,5,2,1")
    scan = read_scan(tmp_path / "scan.npy", bounds=box)
    np.testing.assert_array_equal(scan.around, points[: len(wall)])
    whole = completer.complete(scan.points, density=0.0, around=scan.around)
    done = FrameCompleter(completer, bounds=box).complete(counted(points))
    rows = done.fields["row"]
    np.testing.assert_array_equal(done.points[done.observed], points[rows])
    np.testing.assert_array_equal(done.points, whole.points)
    alone = completer.complete(scan.points, density=0.0)
    assert len(done.points) < len(alone.points)
    assert alone.left_away["looked_through"] == 0 < whole.left_away["looked_through"]


def test_depth_images_are_upright_as_their_camera(completer):
    camera = Camera(np.eye(3), np.zeros(3), np.diag([5.0, 5.0, 1.0]), 20, 20)
    depth = RNG.uniform(1, 1.5, (20, 20))
    frame = Frame.of_depth(depth, camera, 0)
    done = FrameCompleter(completer).complete(frame)
    whole = completer.complete(frame.points, camera, adapt=False, up="-y", density=0.0)
    np.testing.assert_array_equal(done.points, whole.points)


def test_nothing_is_compiled_and_up_is_found_once_it_is_warm(completer):
    """Clouds of fewer points than the network reads, of as many and of more."""
    stream = FrameCompleter(completer, up="auto")
    points = np.concatenate([shell(0) for _ in range(8)])
    stream.warm_up(Frame(points, 0))
    np.testing.assert_allclose(stream.up, [0, 0, 1], atol=1e-6)
    sampling = (observation._farthest, observation._framing)
    before = [compiled._cache_size() for compiled in sampling]
    for count in (64, 65, 127, 128, 129, 1025, 2400):
        stream.complete(Frame(points[:count], 0))
    assert [compiled._cache_size() for compiled in sampling] == before


def test_a_known_robot_is_cut_out_and_put_back(completer, urdf):
    """It stands in front of the box, and moves."""
    robot, base = Linkage(urdf), np.eye(4)
    base[0, 3] = 1.5
    poses = [{"yaw": 0.0, "shoulder": s, "elbow": 0.3} for s in (1.2, -1.2)]
    surfaces = [robot_surface(robot, pose, base) for pose in poses]
    joints = [{"positions": pose, "base": base.tolist()} for pose in poses]
    box = shell(3)
    stream = FrameCompleter(completer, robot=robot, robot_margin=0.05)
    noisy = surfaces[0] + RNG.normal(0, 0.005, surfaces[0].shape)
    points = np.concatenate([noisy, box]).astype(np.float32)
    done = stream.complete(counted(points, joints=joints[0]))
    np.testing.assert_array_equal(points[done.fields["row"]], box)
    np.testing.assert_array_equal(done.points[done.observed], box)
    known = done.points[done.label == KNOWN]
    np.testing.assert_array_equal(known, surfaces[0].astype(np.float32))
    assert not of_robot(done.points[done.label != KNOWN], known, 0.05).any()
    alone = FrameCompleter(completer).complete(Frame(box, 0))
    predicted = alone.points[~alone.observed]
    predicted = predicted[~of_robot(predicted, surfaces[0], 0.05)]
    np.testing.assert_array_equal(done.points[done.label == 1], predicted)
    done = stream.complete(Frame(box, 0, joints=joints[1]))
    known = done.points[done.label == KNOWN]
    np.testing.assert_array_equal(known, surfaces[1].astype(np.float32))
    with pytest.raises(InputError, match="no joint positions"):
        stream.complete(Frame(box, 0))
    with pytest.raises(InputError, match="without its robot: no points"):
        stream.complete(Frame(noisy, 0, joints=joints[0]))


def test_a_known_part_is_followed_and_its_hidden_sides_are_put_back(completer):
    box = trimesh.creation.box((1.0, 1.2, 0.8))
    own = np.asarray(box.vertices), np.asarray(box.faces)
    library = Library([Model("box", *own, surface_of(*own))])
    stream = FrameCompleter(completer.knowing(library))
    sides = RNG.uniform(-0.5, 0.5, (900, 3))
    sides[:300, 0], sides[300:600, 1], sides[600:, 2] = -0.5, 0.5, 0.5
    camera = Camera.look_at((0, 3.0, 2.0), (3.5, 0, 0))
    for shift, moved in ((0.0, 0.0), (0.0, 0.0), (0.3, 0.3)):
        middle = np.array([3.5 + shift, 0, 0])
        points = (sides * [1.0, 1.2, 0.8] + middle).astype(np.float32)
        done = stream.complete(Frame(points, 7, camera))
        assert done.known["model"] == "box" and done.known["refused"] == {}
        assert done.known["moved"] == pytest.approx(moved, abs=0.02)
        assert np.array_equal(done.points[done.label == OBSERVED], points)
        added = (done.points[done.label == KNOWN] - middle) / [1.0, 1.2, 0.8]
        np.testing.assert_allclose(np.abs(added).max(axis=1), 0.5, atol=0.02)
        assert (added[:, 0] > 0.49).any() and (added[:, 2] < -0.49).any()
