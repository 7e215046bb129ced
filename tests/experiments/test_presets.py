"""Presets."""

from experiments.presets import PRESETS
from prism_jax.completion.weights import load_pretrained


def test_paper_has_the_papers_values():
    paper = PRESETS["paper"]
    assert paper.model.backbone.stage_sizes == (1024, 2048, 4096, 16384)
    assert (paper.adapt.num_steps, paper.adapt.step_size) == (3, 1e-3)
    assert paper.model.auxiliary.max_offset == 0.1
    meta, method = paper.meta, paper.meta.method
    assert (meta.optimiser, meta.batch_size) == ("sgd", 32)
    assert (meta.learning_rate, meta.weight_rate) == (5e-5, 5e-4)
    assert (meta.final_rate, meta.warmup_steps, meta.clip_norm) == (1.0, 0, 0.0)
    assert (method.beta_0, method.lambda_aux) == (0.1, 10.0)
    assert method.weight_rule == "auxiliary"
    assert not (method.first_order or method.learn_steps)


def test_a_training_can_go_on_from_what_ships():
    assert load_pretrained("small")[0].model == PRESETS["small"].model
