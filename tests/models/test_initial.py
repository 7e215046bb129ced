"""Fresh variables."""

import jax
import numpy as np

from prism_jax.models.initial import init_auxiliary


def test_what_reads_a_backbone_begins_fresh(minimal, minimal_fresh):
    """Beside the backbone as it was; the losses weigh the same."""
    backbone = {
        kind: {name: minimal_fresh[kind][name] for name in ("point_encoder", "decoder")}
        for kind in ("params", "batch_stats")
    }
    one = init_auxiliary(jax.random.key(1), backbone, minimal.model)
    assert jax.tree.structure(one) == jax.tree.structure(minimal_fresh)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(one))
    for kind, parts in backbone.items():
        assert all(one[kind][name] is tree for name, tree in parts.items())
    for name in ("logits", "scales"):
        assert np.array_equal(one["weighting"][name], np.zeros(3))
    normal, denoiser = (
        one["params"]["auxiliary"][name]["mlp"]["dense_1"]["kernel"]
        for name in ("normal", "denoiser")
    )
    assert normal.std() > 0 and not np.array_equal(normal, denoiser)
