"""Presets."""

import pytest

from prism_jax.completion.weights import load_pretrained
from prism_jax.training.presets import PRESETS


@pytest.mark.parametrize(
    ("name", "num_points", "stages"),
    [
        ("tiny", 64, (32, 32, 64)),
        ("small", 512, (128, 256, 2048)),
        ("paper", 2048, (1024, 2048, 4096, 16384)),
    ],
)
def test_sizes(name, num_points, stages):
    backbone = PRESETS[name].model.backbone
    assert backbone.num_points == num_points
    assert backbone.stage_sizes == stages
    assert len(backbone.level_rates) == len(backbone.up_factors)
    assert len(backbone.encoder_rates) == len(backbone.num_neighbors)


def test_paper_has_the_papers_values():
    paper = PRESETS["paper"]
    assert (paper.adapt.num_steps, paper.adapt.step_size) == (3, 1e-3)
    assert paper.model.auxiliary.max_offset == 0.1
    assert paper.model.depth_pixels == paper.model.consistency_pixels == 128
    meta = paper.meta
    assert (meta.optimiser, meta.batch_size) == ("sgd", 32)
    assert (meta.learning_rate, meta.weight_rate) == (5e-5, 5e-4)
    assert (meta.final_rate, meta.warmup_steps, meta.clip_norm) == (1.0, 0, 0.0)
    assert (meta.method.beta_0, meta.method.lambda_aux) == (0.1, 10.0)
    assert meta.method.weight_rule == "auxiliary"
    assert not meta.method.first_order
    assert not meta.method.learn_steps


def test_a_training_can_go_on_from_what_ships():
    assert load_pretrained("small")[0].model == PRESETS["small"].model


@pytest.mark.parametrize("name", PRESETS)
def test_every_phase_is_a_whole_number_of_batches(name):
    training = PRESETS[name].pretrain
    for phase in training.backbone:
        assert phase.num_samples % training.batch_size == 0
    assert training.auxiliary_samples % training.batch_size == 0
    meta = PRESETS[name].meta
    assert meta.num_samples % meta.batch_size == 0
