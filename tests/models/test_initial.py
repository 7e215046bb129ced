"""Fresh variables."""

import jax
import numpy as np

from prism_jax.models.initial import init_auxiliary


def test_what_reads_a_backbone_begins_fresh(minimal, minimal_fresh):
    """Of a key its own, beside the backbone as it was; the losses weigh the same, and
    none is measured."""
    backbone = {
        kind: {name: minimal_fresh[kind][name] for name in ("point_encoder", "decoder")}
        for kind in ("params", "batch_stats")
    }
    one, other = (
        init_auxiliary(jax.random.key(seed), backbone, minimal.model) for seed in (1, 2)
    )
    assert jax.tree.structure(one) == jax.tree.structure(minimal_fresh)
    for leaf in jax.tree.leaves(one):
        assert leaf.dtype == np.float32
        assert np.isfinite(leaf).all()
    for kind, parts in backbone.items():
        for name, tree in parts.items():
            assert one[kind][name] is tree
    for name in ("logits", "scales"):
        assert np.array_equal(one["weighting"][name], np.zeros(3))
    kernels = [
        tree["params"]["auxiliary"][name]["mlp"]["dense_1"]["kernel"]
        for name in ("normal", "denoiser")
        for tree in (one, other)
    ]
    assert len(np.unique(kernels, axis=0)) == 4
