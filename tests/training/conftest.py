"""Examples made of random boxes, and a phase that compiles to nothing."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from prism_jax.data.pipeline import Framing, frame_example, stack
from prism_jax.data.source import Example
from prism_jax.training.phase import Phase, TrainState


class Boxes:
    """Surfaces of boxes, and the half of each that a sensor sees, in memory."""

    categories = ("even", "odd")

    def __init__(self, count, seed):
        rng = np.random.default_rng(seed)
        sizes = rng.uniform(0.3, 1.0, (count, 1, 3))
        sizes /= sizes.max(-1, keepdims=True)
        surface = rng.uniform(-1, 1, (count, 4200, 3))
        surface /= np.abs(surface).max(-1, keepdims=True)
        eyes = rng.normal(size=(count, 1, 3))
        eyes *= 3.0 / np.linalg.norm(eyes, axis=-1, keepdims=True)
        near = surface[:, :2048]
        seen = near * np.sign((near * eyes).sum(-1))[..., None]
        self._complete = (surface * sizes).astype(np.float32)
        self._partial = (seen * sizes).astype(np.float32)
        self._eyes = eyes[:, 0].astype(np.float32)
        self.objects = np.arange(count)

    def __len__(self):
        return len(self._eyes)

    def __getitem__(self, index):
        return Example(
            self._complete[index],
            self._partial[index],
            self._eyes[index],
            self.categories[index % 2],
            str(index),
            ordered=True,
        )


def regression_phase(batch_size, num_steps, rate):
    """Fits the eye as a multiple, per axis, of the partial's mean."""
    adam = optax.adam(rate)

    def error(params, batch):
        return ((batch.partial.mean(1) * params["w"] - batch.eye) ** 2).mean()

    @jax.jit
    def step(state, batch):
        params = state.variables["params"]
        loss, grads = jax.value_and_grad(error)(params, batch)
        updates, opt_state = adam.update(grads, state.opt_state)
        variables = {"params": optax.apply_updates(params, updates)}
        return TrainState(state.step + 1, variables, opt_state), loss[None]

    @jax.jit
    def validate(variables, batch):
        # Which fast steps come near on their way, and leave behind.
        score = ((variables["params"]["w"] - 3.0) ** 2).mean()
        return jnp.stack([batch.scale, jnp.full(len(batch.eye), score)], -1)

    params = {"w": jnp.zeros(3)}
    start = TrainState(jnp.int32(0), {"params": params}, adam.init(params))
    sizes = num_steps * batch_size, batch_size, 128
    names = ("loss",), ("scale", "score")
    return Phase("toy", *sizes, start, step, validate, *names)


def lines(folder):
    """What a training logged."""
    text = (folder / "metrics.jsonl").read_text()
    return [json.loads(line) for line in text.splitlines()]


@pytest.fixture(scope="session")
def examples():
    return Boxes(20, seed=0)


@pytest.fixture(scope="session")
def validation_examples():
    return Boxes(10, seed=1)


@pytest.fixture(scope="session")
def framed():
    """``(source, rows, framing) -> Batch`` of those examples as they are."""

    def batch(source, rows, framing):
        return stack([frame_example(source[int(row)], framing) for row in rows])

    return batch


@pytest.fixture(scope="session")
def batch(examples, framed):
    """Four of them."""
    return framed(examples, range(4), Framing(64, 128, 1.4))
