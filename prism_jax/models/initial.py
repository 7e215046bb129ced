"""Fresh variables of the whole model."""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from prism_jax.geometry.camera import Camera
from prism_jax.losses.weighting import BRANCHES
from prism_jax.models import prism
from prism_jax.models.auxiliary import Refiner
from prism_jax.models.backbone import init_backbone
from prism_jax.models.config import ModelConfig
from prism_jax.models.depth_encoder import DepthEncoder
from prism_jax.models.variables import ENCODERS, Variables, on_cpu


def init_variables(key: PRNGKeyArray, config: ModelConfig) -> Variables:
    """Everything that ``adapt`` and training need, in the structure of `variables`."""
    first, second = jax.random.split(key)
    return init_auxiliary(second, init_backbone(first, config.backbone), config)


def init_auxiliary(
    key: PRNGKeyArray, backbone: Variables, config: ModelConfig
) -> Variables:
    """A backbone's variables with fresh ones for all that reads it, made on the CPU as
    the backbone's are; nothing depends on the backbone's values."""
    sizes = config.auxiliary

    def init(key: PRNGKeyArray) -> dict[str, Any]:
        # Each module takes the next key: their order is a part of what a seed means.
        first, *keys = jax.random.split(key, 7)
        fresh = {}

        def made(module: nn.Module, *arguments: Any) -> Any:
            key = keys[len(fresh)]
            output, fresh[module.name] = module.init_with_output(key, *arguments)
            return output

        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), backbone)
        shape = (config.backbone.num_points, 3)
        cloud = jax.random.uniform(first, shape, minval=-1.0)
        camera = Camera.look_at((3.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        inputs = prism.prepare_input(cloud, camera, first, config)
        encoded = prism.encode(zeros, inputs, config)
        stages, features, _ = prism.decode(zeros, inputs, encoded, config)
        image = inputs.depth, inputs.depth_mask
        depth_tokens = made(DepthEncoder(sizes, name="depth_encoder"), *image)
        made(Refiner(sizes, name="refiner"), stages[-1], features)
        prediction = prism.Prediction(stages[-1], stages, features, encoded)
        prism.run_auxiliary(made, inputs, prediction, depth_tokens, config)
        return fresh

    with on_cpu():
        fresh = jax.jit(init)(key)
    depth, refiner = fresh.pop("depth_encoder"), fresh.pop("refiner")
    params = {
        **backbone["params"],
        "depth_encoder": depth["params"],
        "refiner": refiner["params"],
        "auxiliary": {name: own["params"] for name, own in fresh.items()},
    }
    statistics = {**backbone["batch_stats"], "depth_encoder": depth["batch_stats"]}
    unlearned = {n: dict.fromkeys(params[n], jnp.zeros(())) for n in ENCODERS}
    weighting = {
        "logits": jnp.zeros(len(BRANCHES)),
        "scales": jnp.zeros(len(BRANCHES)),
        "log_steps": unlearned,
    }
    return {"params": params, "batch_stats": statistics, "weighting": weighting}
