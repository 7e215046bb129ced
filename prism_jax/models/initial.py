"""Fresh variables of the whole model."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from prism_jax.geometry.camera import Camera
from prism_jax.losses.weighting import BRANCHES
from prism_jax.models import prism
from prism_jax.models.backbone import decode, init_backbone
from prism_jax.models.config import ModelConfig
from prism_jax.models.depth_encoder import DepthEncoder
from prism_jax.models.refiner import Refiner
from prism_jax.models.variables import Variables, on_cpu, unlearned_steps


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
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), backbone)

    def init(key: PRNGKeyArray) -> dict[str, Any]:
        keys = jax.random.split(key, 7)
        backbone = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        shape = (config.backbone.num_points, 3)
        cloud = jax.random.uniform(keys[0], shape, minval=-1.0)
        view = (3.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        inputs = prism.prepare_input(cloud, Camera.look_at(*view), keys[0], config)
        encoded = prism.encode(backbone, inputs, config)
        decoded = decode(
            backbone, config.backbone, cloud, encoded, visibility=inputs.visibility
        )
        points, features = decoded.stages[-1], decoded.features
        fresh = {"refiner": Refiner(sizes).init(keys[2], points, features)}
        image = inputs.depth, inputs.depth_mask
        depth_features, fresh["depth_encoder"] = DepthEncoder(sizes).init_with_output(
            keys[1], *image
        )

        def made(name: str, *arguments: Any) -> Any:
            module, key = (
                prism.AUXILIARY[name](sizes),
                keys[3 + [*prism.AUXILIARY].index(name)],
            )
            output, fresh[name] = module.init_with_output(key, *arguments)
            return output

        prediction = prism.Prediction(points, decoded.stages, features, encoded)
        prism.run_auxiliary(made, inputs, prediction, depth_features)
        return fresh

    with on_cpu():
        fresh = jax.jit(init)(key)
    depth = fresh.pop("depth_encoder")
    params = {name: variables["params"] for name, variables in fresh.items()}
    params = {
        **backbone["params"],
        "depth_encoder": depth["params"],
        "refiner": params.pop("refiner"),
        "auxiliary": params,
    }
    statistics = {**backbone["batch_stats"], "depth_encoder": depth["batch_stats"]}
    weighting = {
        "logits": jnp.zeros(len(BRANCHES)),
        "scales": jnp.zeros(len(BRANCHES)),
        "log_steps": unlearned_steps(params),
    }
    return {"params": params, "batch_stats": statistics, "weighting": weighting}
