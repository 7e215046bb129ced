"""Frames, what is held out of them, pseudo-labels, and what the student reads."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial import KDTree

from experiments.plants.frames import (
    Unlabelled,
    evenly,
    held_out,
    other_sequences,
    pseudo_label,
    read_frames,
    student_view,
)
from experiments.plants.occlusion import occluded
from prism_jax.data.pipeline import Framing
from prism_jax.io.errors import InputError


@pytest.fixture(scope="module")
def frames(boxes, minimal):
    return read_frames(Unlabelled(boxes()), minimal.config)


def test_truth_is_dropped_and_all_else_stays(boxes):
    source, bare = boxes(1.0), Unlabelled(boxes(1.0))
    assert bare[3].complete is None and source[3].complete is not None
    np.testing.assert_array_equal(bare[3].partial, source[3].partial)
    assert (len(bare), bare.categories) == (len(source), source.categories)
    np.testing.assert_array_equal(bare.objects, source.objects)
    assert len(evenly(bare, 4)) == 4
    assert evenly(bare, None) is bare


def test_a_frame_holds_what_was_measured(frames, boxes):
    example = boxes()[5]
    assert (frames[5].name, frames[5].object) == (example.name, 2)
    np.testing.assert_array_equal(frames[5].measured, example.partial)
    read = frames[5].seen.workspace.from_unit(frames[5].seen.partial)
    assert KDTree(example.partial).query(read)[0].max() < 1e-5


def test_every_fifth_sequence_checks_or_every_fifth_frame():
    train, check = held_out(np.repeat(np.arange(11), 3))
    assert set(check // 3) == {2, 7}
    assert sorted([*train, *check]) == list(range(33))
    train, check = held_out(np.zeros(11, int))
    np.testing.assert_array_equal(check, [2, 7])
    with pytest.raises(InputError, match="too few"):
        held_out(np.arange(4))


def test_scored_sequences_are_others_of_the_same_robots(boxes):
    source = boxes()
    names = [source[row].category for row in range(len(source))]
    rows, scored = other_sequences(source, names)
    assert set(source.objects[rows]) == {0, 1, 4, 5}
    assert set(source.objects[scored]) == {2, 3}
    rows, scored = other_sequences(source, [*"aaaaaaaaaaab"])
    assert 11 in rows and 11 not in scored


def test_a_label_is_what_was_measured_and_what_agrees_with_it(frames):
    frame = frames[0]
    seen = frame.seen
    eye = np.asarray(seen.eye)
    behind = np.asarray(seen.partial) - 0.5 * eye / np.linalg.norm(eye)
    before = 0.5 * (np.asarray(seen.partial) + eye)
    label = pseudo_label(frame, np.concatenate([behind, before]), 900, 9.0)
    assert label.shape == (900, 3)
    unit = np.asarray(seen.workspace.to_unit(label))
    assert KDTree(before).query(unit)[0].min() > 0.1
    assert (KDTree(behind).query(unit)[0] < 1e-6).sum() > 10
    assert KDTree(label).query(frame.measured)[0].max() < 0.2
    label = pseudo_label(frame, behind, 900, 0.1)
    unit = np.asarray(seen.workspace.to_unit(label))
    measured = np.asarray(seen.workspace.to_unit(frame.measured))
    assert KDTree(measured).query(unit)[0].max() <= 0.1


def test_the_student_reads_what_is_left_and_is_asked_for_the_rest(frames, minimal):
    frame, model = frames[0], minimal.model
    framing = Framing(model.backbone.num_points, 128 + 32, model.margin, "given")
    label = frame.measured[:128]
    batch = student_view(frame, label, 32, 0.0, framing, np.random.default_rng(7))
    rng = np.random.default_rng(7)
    rng.random()
    kept, hidden, _ = occluded(frame.measured, frame.eye, rng)
    assert np.abs(batch.partial).max() <= 1.0
    assert batch.complete.shape == (160, 3)
    # Framed and mirrored, lengths keep their proportions.
    size = np.ptp(batch.partial, axis=0).max() / np.ptp(kept, axis=0).max()
    apart = KDTree(batch.partial).query(batch.complete[128:])[0]
    expected = KDTree(kept).query(hidden)[0]
    assert apart.max() <= size * (expected.max() + 0.4)
    assert apart.min() > 0
    rng = np.random.default_rng(7)
    batch = student_view(frame, label, 64, 1.0, framing, rng)
    assert KDTree(batch.partial).query(batch.complete[128:])[0].min() < 1e-6


def test_frames_without_measured_points_are_refused(boxes, minimal):
    class Bare(boxes):
        def __getitem__(self, index):
            return super().__getitem__(index)._replace(partial=None)

    with pytest.raises(InputError, match="no measured points"):
        read_frames(Unlabelled(Bare()), minimal.config)


def test_a_sensor_that_nobody_knows_is_none(boxes, minimal):
    class Blind(boxes):
        def __getitem__(self, index):
            nowhere = np.full(3, np.nan, np.float32)
            return super().__getitem__(index)._replace(eye=nowhere)

    frames = read_frames(evenly(Blind(), 2), minimal.config)
    assert frames[0].eye is None
    assert dataclasses.is_dataclass(frames[0].seen) and not frames[0].seen.sensor_known
