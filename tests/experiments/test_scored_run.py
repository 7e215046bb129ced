"""Completers that are no networks, run over a source and scored."""

import numpy as np
import pytest

from experiments import scoring
from experiments.paired import paired_difference
from experiments.protocol import (
    NORMALISATIONS,
    Protocol,
    observed,
    side_by_side,
)
from experiments.scored_run import Predictions, evaluate, scored_clouds
from experiments.scoring import prism_completer
from prism_jax.adaptation.config import PrismConfig
from prism_jax.adaptation.objective import Losses
from prism_jax.adaptation.test_time import Completion
from prism_jax.completion.assembly import Task, assemble
from prism_jax.completion.options import CompletionOptions
from prism_jax.data.source import Example
from prism_jax.evaluation import metrics
from prism_jax.evaluation.scoring import CLOUDS
from prism_jax.geometry.workspace import Workspace
from prism_jax.io import InputError
from prism_jax.preprocessing.observation import observe
from tests import stand_in_networks

METRES = {"scale": 0.35, "shift": (2.0, -1.0, 4.0)}


def same(partials, eyes):
    """Returns what it is given."""
    assert partials.shape[2] == eyes.shape[1] == 3
    return Predictions(partials)


def mirrored(partials, eyes):
    """Adapted by mirroring, where the partial lies upwards of the workspace."""
    accepted = partials[:, :, 2].mean(axis=1) > 0
    output = partials * np.float32([1, 1, -1])
    return Predictions(output, partials, accepted)


def mean_of(result, cloud="network") -> dict[str, float]:
    return result["clouds"][cloud]["mean"]


def protocol(normalisation="partial", **changes) -> Protocol:
    return Protocol(60, 1.4, normalisation, with_emd=False, **changes)


@pytest.mark.parametrize("normalisation", NORMALISATIONS)
def test_a_partial_returned_is_a_partial_scored(boxes, normalisation):
    """In every frame, and in metres as in any unit."""
    source = boxes(objects=3, **METRES)
    expected = np.mean([metrics.score(s.partial, s.complete).cd_l1 for s in source])
    result = evaluate(same, source, protocol(normalisation))
    found = mean_of(result, "partial")["cd_l1"] * METRES["scale"]
    assert np.isclose(found, expected, rtol=1e-4)
    assert result["unit"] == "half the longest side of the complete cloud"
    if normalisation == "own":
        own = evaluate(same, source, protocol("own", unit="own"))
        assert own["unit"] == "the data set's own unit"
        assert np.isclose(mean_of(own, "partial")["cd_l1"], expected, rtol=1e-4)


def test_who_knows_the_answer_scores_zero(boxes):
    """In the oracle's frame, the complete cloud is as large as the margin says."""
    source = boxes(objects=1, **METRES)
    answer = boxes(objects=1)[0].complete / np.float32(1.4)
    told = Predictions(answer[None])
    result = evaluate(lambda p, e: told, source, Protocol(60, 1.4, "oracle"))
    assert tuple(mean_of(result)) == metrics.Scores._fields
    assert 0 < mean_of(result, "partial")["emd"] < 1
    assert mean_of(result)["hausdorff"] < 1e-5
    assert mean_of(result)["f_score"] == 1
    blind = evaluate(lambda p, e: told, source, protocol())
    assert mean_of(blind)["hausdorff"] > 0.01


def test_completed_is_what_a_user_gets(boxes):
    """As `completion.assembly.assemble` makes it, in the frame of the scores."""
    example, own = boxes(objects=1, **METRES)[0], protocol()
    read = np.asarray(observed(example, own).partial)
    prediction = (read * np.float32([1, 1, -1]))[:40]
    clouds = scored_clouds(example, read, Predictions(prediction, prediction), own)
    seen = observe(example.partial.astype(np.float64), example.eye, own)
    read_too = seen.sampled(own.num_partial)
    task = Task(example.partial, seen, read_too, seen.camera, "given")
    losses = Losses(*np.ones((len(Losses._fields), 1)))
    done = Completion(prediction, prediction, False, losses, np.ones(3), {}, ())
    result = assemble(task, done, CompletionOptions(), {})
    frame = Workspace.from_points(example.complete, 1.0)
    expected = np.asarray(frame.to_unit(result.points.astype(np.float64)))
    count = len(example.partial)
    assert len(expected) > count + len(prediction) / 2
    np.testing.assert_allclose(clouds["completed"], expected, atol=1e-5)
    assert clouds["completed_unadapted"] is clouds["completed"]
    np.testing.assert_allclose(clouds["partial"], expected[:count], atol=1e-6)


def test_batches_change_nothing_and_have_one_size(boxes):
    source, sizes, results = boxes(objects=4, views=2), [], []

    def noting(partials, eyes):
        sizes.append(len(partials))
        return mirrored(partials, eyes)

    for size in (2, 20):
        found = evaluate(noting, source, protocol(), limit=5, batch_size=size)
        results.append(found)
    assert results[0] == results[1]
    assert sizes == [2, 2, 2, 5]
    assert (found["num_examples"], found["num_objects"]) == (5, 3)
    assert found["per_example"]["name"] == ["0/0", "0/1", "1/0", "1/1", "2/0"]
    assert found["per_example"]["category"][2] == "tall"


def test_an_adapted_output_has_one_that_is_not(boxes):
    result = evaluate(mirrored, boxes(), protocol())
    without = evaluate(same, boxes(), protocol())
    assert tuple(result["clouds"]) == CLOUDS
    assert list(without["clouds"]) == ["partial", "network", "completed"]
    assert result["accepted"] == 1
    # A partial seen from above, mirrored in the middle of its own box, is farther away.
    for name in ("network", "completed"):
        change = paired_difference(result, result, clouds=(f"{name}_unadapted", name))
        assert result["adaptation"][name]["cd_l2"] == change
        before = mean_of(result, f"{name}_unadapted")
        expected = mean_of(result, name)["cd_l2"] / before["cd_l2"] - 1
        assert np.isclose(change["change"], expected, rtol=1e-4)
        assert mean_of(without, name) == before
    assert not {"accepted", "adaptation"} & without.keys()


def test_a_fault_of_the_completer_ends_it(boxes):
    class Blind(boxes):
        def __getitem__(self, index) -> Example:
            return super().__getitem__(index)._replace(complete=None)

    with pytest.raises(ValueError, match="finite"):
        evaluate(lambda p, e: Predictions(p * np.nan), boxes(), protocol())
    with pytest.raises(InputError, match="no complete cloud"):
        evaluate(same, Blind(), protocol())


def test_prism_is_a_completer(boxes, monkeypatch):
    """Frame by frame, by a stand-in that moves them towards sensors above them."""
    monkeypatch.setattr(scoring, "make_adapt", stand_in_networks.make_adapt)
    partials, eyes = side_by_side([observed(boxes()[i], protocol()) for i in (0, 1)])
    eyes[1] *= -1
    done = prism_completer(PrismConfig(), {})(partials, eyes)
    np.testing.assert_array_equal(done.network_unadapted, partials)
    np.testing.assert_array_equal(done.accepted, [True, False])
    moved = partials + 0.05 * eyes[:, None] * [[[1]], [[0]]]
    np.testing.assert_allclose(done.network, moved, atol=1e-5)
    alone = prism_completer(PrismConfig().with_adapt(num_steps=0), {})
    assert alone(partials, eyes)[1:] == (None, None)
