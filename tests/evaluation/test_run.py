"""Completers that are no networks, run over a source and scored."""

import jax
import numpy as np
import pytest

from prism_jax.adaptation.config import AdaptConfig, PrismConfig
from prism_jax.adaptation.objective import Losses
from prism_jax.adaptation.test_time import Completion
from prism_jax.completion.assembly import Task, assemble
from prism_jax.completion.options import CompletionOptions
from prism_jax.data.source import Example
from prism_jax.evaluation import metrics
from prism_jax.evaluation.paired import paired_difference
from prism_jax.evaluation.protocol import NORMALISATIONS, Protocol, observed
from prism_jax.evaluation.run import (
    Predictions,
    evaluate,
    prism_completer,
    scored_clouds,
)
from prism_jax.evaluation.scoring import CLOUDS
from prism_jax.geometry.workspace import Workspace
from prism_jax.io import InputError
from prism_jax.preprocessing.observation import observe

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
    source = boxes(**METRES)
    result = evaluate(same, source, protocol(normalisation))
    expected = []
    for i in range(len(source)):
        clouds = source[i].partial, source[i].complete
        expected.append(metrics.cd_l1(*clouds) / METRES["scale"])
    assert np.isclose(mean_of(result, "partial")["cd_l1"], np.mean(expected), rtol=1e-4)
    unit = boxes()
    few = evaluate(same, unit, protocol("partial"))
    assert np.isclose(mean_of(result)["cd_l2"], mean_of(few)["cd_l2"], rtol=1e-4)
    assert result["unit"] == "half the longest side of the complete cloud"
    assert result["num_partial"] == 60


def test_who_knows_the_answer_scores_zero(boxes):
    """In the oracle's frame, the complete cloud is as large as the margin says."""
    source = boxes(objects=1, **METRES)
    answer = boxes(objects=1)[0].complete / np.float32(1.4)
    told = Predictions(answer[None])
    result = evaluate(lambda p, e: told, source, protocol("oracle"))
    assert mean_of(result)["hausdorff"] < 1e-5
    assert mean_of(result)["f_score"] == 1
    blind = evaluate(lambda p, e: told, source, protocol())
    assert mean_of(blind)["hausdorff"] > 0.01


def test_the_own_unit_is_the_data_sets(boxes):
    source, metres = boxes(), boxes(**METRES)
    one = evaluate(same, source, protocol("own", unit="own"))
    other = evaluate(same, metres, protocol("own", unit="own"))
    assert other["unit"] == "the data set's own unit"
    ratio = mean_of(other)["cd_l1"] / mean_of(one)["cd_l1"]
    assert np.isclose(ratio, METRES["scale"], rtol=1e-4)


@pytest.fixture(scope="module")
def whole(boxes):
    """Five examples in one batch."""
    source = boxes(objects=4, views=2)
    return evaluate(mirrored, source, protocol(), limit=5, batch_size=5)


def test_completed_is_what_a_user_gets(boxes):
    """As `completion.assembly.assemble` makes it, in the frame of the scores."""
    example = boxes(objects=1, **METRES)[0]
    own = protocol()
    read = np.asarray(observed(example, own).partial)
    prediction = (read * np.float32([1, 1, -1]))[:40]
    clouds = scored_clouds(example, read, Predictions(prediction, prediction), own)
    seen = observe(example.partial.astype(np.float64), example.eye, margin=own.margin)
    read_too = seen.sampled(own.num_partial)
    task = Task(example.partial, seen, read_too, seen.camera, "given")
    losses = Losses(*np.ones((len(Losses._fields), 1)))
    done = Completion(prediction, prediction, False, losses, np.ones(3), {}, ())
    result = assemble(task, done, CompletionOptions(), {})
    frame = Workspace.from_points(example.complete, 1.0)
    expected = np.asarray(frame.to_unit(result.points.astype(np.float64)))
    assert len(expected) > len(example.partial) + len(prediction) / 2
    np.testing.assert_allclose(clouds["completed"], expected, atol=1e-5)
    assert clouds["completed_unadapted"] is clouds["completed"]
    np.testing.assert_allclose(
        clouds["partial"], expected[: len(example.partial)], atol=1e-6
    )


@pytest.mark.parametrize("batch_size", [1, 2, 3, 20])
def test_batches_change_nothing(boxes, whole, batch_size):
    source = boxes(objects=4, views=2)
    parts = evaluate(mirrored, source, protocol(), limit=5, batch_size=batch_size)
    assert parts == whole
    assert parts["num_examples"] == 5
    assert parts["num_objects"] == 3
    assert parts["per_example"]["name"] == ["0/0", "0/1", "1/0", "1/1", "2/0"]
    assert parts["per_example"]["category"][2] == "tall"


def test_batches_all_have_one_size(boxes):
    sizes = []
    evaluate(
        lambda p, e: sizes.append(len(p)) or same(p, e),
        boxes(objects=5),
        protocol(),
        batch_size=2,
    )
    assert sizes == [2, 2, 2]


def test_an_adapted_output_has_one_that_is_not(boxes):
    result = evaluate(mirrored, boxes(), protocol())
    assert tuple(result["clouds"]) == CLOUDS
    for scores in result["clouds"].values():
        assert set(scores) == {"mean", "median", "intervals", "per_category"}
    assert result["accepted"] == 1
    # A partial seen from above, mirrored in the middle of its own box, is farther away.
    for name in ("network", "completed"):
        change = paired_difference(result, result, clouds=(f"{name}_unadapted", name))
        assert result["adaptation"][name]["cd_l2"] == change
        before = mean_of(result, f"{name}_unadapted")["cd_l2"]
        expected = mean_of(result, name)["cd_l2"] / before - 1
        assert np.isclose(change["change"], expected, rtol=1e-4)
    without = evaluate(same, boxes(), protocol())
    assert list(without["clouds"]) == ["partial", "network", "completed"]
    for name in ("network", "completed"):
        assert mean_of(without, name) == mean_of(result, f"{name}_unadapted")
    assert not {"accepted", "adaptation"} & without.keys()


def test_a_jitted_function_is_a_completer(boxes):
    plain = evaluate(mirrored, boxes(), protocol())
    jitted = evaluate(jax.jit(mirrored), boxes(), protocol())
    assert jitted["per_example"]["name"] == plain["per_example"]["name"]
    for name in ("hausdorff", "f_score"):
        found = mean_of(jitted)[name]
        np.testing.assert_allclose(found, mean_of(plain)[name], rtol=1e-6)


def test_every_metric_is_there(boxes):
    result = evaluate(same, boxes(objects=1), Protocol(60, 1.4))
    assert tuple(mean_of(result)) == metrics.Scores._fields
    assert 0 < mean_of(result)["emd"] < 1


def test_a_fault_of_the_completer_ends_it(boxes):
    def broken(partials, eyes):
        raise RuntimeError("no network")

    with pytest.raises(RuntimeError, match="no network"):
        evaluate(broken, boxes(), protocol())
    with pytest.raises(ValueError, match="finite"):
        evaluate(lambda p, e: Predictions(p * np.nan), boxes(), protocol())


def test_an_example_without_truth_is_refused(boxes):
    class Blind(boxes):
        def __getitem__(self, index) -> Example:
            return super().__getitem__(index)._replace(complete=None)

    with pytest.raises(InputError, match="no complete cloud"):
        evaluate(same, Blind(), protocol())


@pytest.mark.parametrize("steps", [0, 3])
def test_prism_is_a_completer(minimal, minimal_variables, steps):
    config = PrismConfig(minimal.model, AdaptConfig(steps, normal_neighbors=4))
    points = minimal.model.backbone.num_points
    shapes = jax.eval_shape(
        prism_completer(config, minimal_variables),
        np.zeros((2, points, 3), np.float32),
        np.zeros((2, 3), np.float32),
    )
    outputs = minimal.model.backbone.stage_sizes[-1]
    assert shapes.network.shape == (2, outputs, 3)
    if steps == 0:
        assert shapes.network_unadapted is shapes.accepted is None
        return
    assert shapes.network_unadapted.shape == (2, outputs, 3)
    assert (shapes.accepted.shape, shapes.accepted.dtype) == ((2,), bool)
