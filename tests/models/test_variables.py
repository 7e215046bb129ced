"""Taking variables apart and putting them together."""

import copy

import jax
import jax.numpy as jnp
import numpy as np

from prism_jax.models.variables import (
    ENCODERS,
    on_cpu,
    part,
    pop_encoders,
    put_encoders,
)
from tests.trees import bitwise

NAMES = ("decoder", "point_encoder", "depth_encoder", "refiner")
VARIABLES = {
    "params": {name: {"dense": {"kernel": np.ones(len(name))}} for name in NAMES},
    "batch_stats": {"decoder": {"norm": {"mean": np.zeros(2)}}, "point_encoder": {}},
    "weighting": {"logits": np.zeros(3)},
}


def test_encoders_taken_out_and_put_back():
    before = copy.deepcopy(VARIABLES)
    encoders, rest = pop_encoders(VARIABLES)
    assert set(encoders) == {"point_encoder", "depth_encoder"}
    assert set(rest["params"]) == {"decoder", "refiner"}
    assert bitwise(put_encoders(encoders, rest), VARIABLES)
    assert bitwise(VARIABLES, before)
    moved = jax.tree.map(lambda leaf: leaf + 1, encoders)
    together = put_encoders(moved, rest)
    assert bitwise({name: together["params"][name] for name in ENCODERS}, moved)
    assert bitwise(pop_encoders(together)[1], rest)


def test_part():
    own = part(VARIABLES, "decoder")
    assert bitwise(own["params"], VARIABLES["params"]["decoder"])
    assert bitwise(own["batch_stats"], VARIABLES["batch_stats"]["decoder"])
    assert set(part(VARIABLES, "decoder", "dense")["params"]) == {"kernel"}
    # Flax takes a missing collection for an empty one, and not the reverse.
    assert set(part(VARIABLES, "point_encoder")) == {"params"}


def test_on_cpu_where_jax_has_none(monkeypatch):
    def unknown(backend):
        raise RuntimeError(f"Unknown backend {backend}")

    with on_cpu():
        assert jnp.ones(2).device.platform == "cpu"
    monkeypatch.setattr(jax, "local_devices", unknown)
    with on_cpu():
        assert jnp.ones(2).sum() == 2
