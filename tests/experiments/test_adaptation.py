"""The table of what steps gain. Its networks are fakes, but for the oracle's."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from experiments import adaptation
from experiments.assets import CELLS
from prism_jax.evaluation.protocol import Told
from prism_jax.evaluation.run import Predictions
from prism_jax.geometry.visibility import seen_by
from prism_jax.weights import load_pretrained, save_weights
from tests import launching


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """What the command writes, what it prints, and what the completers were given."""
    folder = tmp_path_factory.mktemp("adaptation")
    config, variables = load_pretrained("small")
    other = folder / "other.safetensors"
    save_weights(other, config.with_adapt(seed=5), variables, {})
    calls = []

    def fake(config, variables):
        """Moves the partial up by its steps, and away from the sensor."""

        def complete(partials, eyes, told=None):
            settings = config.adapt
            calls.append((config, eyes, told))
            moved = partials + np.float32([0, 0, 0.01 * settings.num_steps])
            if settings.num_steps == 0:
                return Predictions(partials)
            return Predictions(moved, partials, np.ones(len(partials), bool))

        return complete

    output = folder / "table.json"
    place = ["--dataset=recordings", f"--data_dir={CELLS}", "--limit=2", "--split=all"]
    given = [f"--plant={other}", "--set=adapt.num_steps=2", f"--output={output}"]
    given += [f"--learned={other}", "--learned_set=adapt.num_steps=3"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(adaptation, "prism_completer", fake)
        patch.setattr(adaptation, "oracle_completer", fake)
        assert launching.run(adaptation, *place, *given) == 0
    return json.loads(output.read_text()), output.with_suffix(".md").read_text(), calls


def test_rows_and_what_they_are_compared_with(table):
    table, text, _ = table
    rows = table["rows"]
    assert list(rows) == [
        *("blind", "blind, removed", "told", "told, removed"),
        adaptation.PAPER,
        adaptation.ADAPTED,
        *(adaptation.WRONG, adaptation.WRONG_ADAPTED),
        *(adaptation.ORACLE, adaptation.LEARNED, adaptation.PLANT),
    ]
    assert table["against"] == "told, removed"
    means = {label: row["mean"]["cd_l2"] for label, row in rows.items()}
    # The fakes tell nothing apart but the steps, and all see the same cloud.
    assert means["blind"] == means["told"]
    assert means["blind, removed"] == means["told, removed"] == means[adaptation.PLANT]
    # One step, two, and what was removed after them.
    assert (
        len({means[row] for row in ("told", adaptation.PAPER, adaptation.ADAPTED)}) == 3
    )
    assert means[adaptation.LEARNED] > means[adaptation.ADAPTED]
    assert table["learned"]["num_steps"] == 3
    assert table["new"]["num_steps"] == 2
    assert [(p["row"], p["against"]) for p in table["pairs"]] == [
        (after, before) for before, after in adaptation.PAIRS
    ]
    change = table["pairs"][4]["change"]
    assert change == rows[adaptation.ADAPTED]["change"]
    assert change["cd_l2"]["carried_by"]["category"] in ("panda", "ur5")
    assert set(change) >= {"cd_l1", "truth_to_prediction", "prediction_to_truth"}
    assert f"| {adaptation.ADAPTED} | told, removed | " in text
    assert "num_steps 2" in text and "over 2 categories" in text


def test_who_is_told_what(table):
    _, _, calls = table
    seeds = [config.adapt.seed for config, *_ in calls]
    assert seeds == [0] * (len(calls) - 2) + [5] * 2
    backgrounds = [config.model.background for config, *_ in calls]
    assert backgrounds == ["unknown"] * 2 + ["empty"] * (len(calls) - 2)
    assert [told is None for *_, told in calls] == [True] * 2 + [False] * (
        len(calls) - 2
    )
    eyes = np.stack([eyes for _, eyes, _ in calls])
    right, wrong = eyes[0], eyes[5]
    assert (np.delete(eyes, 5, axis=0) == right).all()
    np.testing.assert_allclose(wrong[:, 0], -right[:, 1])
    np.testing.assert_allclose(wrong[:, 1:], np.stack([right[:, 0], right[:, 2]], 1))


def test_a_wrong_sensor_knows_what_the_right_one_knew_elsewhere():
    def same(partials, eyes, told):
        return Predictions(np.asarray(told.visibility.camera.position))

    cloud = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (50, 3)), jnp.float32)
    eye = np.array([[3.0, 1.0, 2.0]], np.float32)
    told = Told(seen_by(cloud, eye[0]), np.zeros((1, 4, 3), np.float32))
    found = adaptation.from_wrong_sensor(same)(cloud[None], eye, told).network
    np.testing.assert_allclose(found, [-1.0, 3.0, 2.0], atol=1e-5)


@pytest.mark.slow
def test_steps_along_the_true_gradient_lower_the_error(
    minimal, minimal_fresh, tiny_frames
):
    config = minimal.config.with_adapt(num_steps=2, step_size=0.02, clip_norm=1.0)
    partials, cameras = (np.asarray(tiny_frames[0]), tiny_frames[1])
    eyes = np.stack(
        [
            np.asarray(jnp.linalg.inv(r)) @ -np.asarray(t)
            for r, t in zip(cameras.rotation, cameras.translation, strict=True)
        ]
    )
    complete = np.concatenate([partials, -partials], axis=1)
    told = Told(None, complete)
    found = adaptation.oracle_completer(config, minimal_fresh)(partials, eyes, told)

    def error(points, truth):
        squares = ((points[:, None] - truth) ** 2).sum(-1)
        return squares.min(1).mean() + squares.min(0).mean()

    for before, after, truth in zip(
        found.network_unadapted, found.network, complete, strict=True
    ):
        assert error(np.asarray(after), truth) < error(np.asarray(before), truth)


def test_rows_that_are_compared_with_nothing_are_refused(capsys):
    assert launching.run(adaptation, "--rows=blind", "--split=novel") == 2
    assert "add one of paper, new, learned or oracle" in capsys.readouterr().err
    assert launching.run(adaptation, "--rows=learned", "--split=novel") == 2
    assert "none of them says what the network is" in capsys.readouterr().err


def test_other_sizes_are_refused(tmp_path, capsys, minimal, minimal_variables):
    path = tmp_path / "minimal.safetensors"
    save_weights(path, minimal.config, minimal_variables, {})
    place = ("--dataset=shapes", f"--data_dir={tmp_path}")
    assert launching.run(adaptation, f"--plant={path}", *place) == 2
    assert "is made for 64 points to 64" in capsys.readouterr().err
