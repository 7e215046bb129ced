"""Pointwise networks shared by every module. Channels last, any leading axes."""

from collections.abc import Callable, Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from prism_jax.geometry import kernels


def highest(features: Float[Array, "... N C"]) -> Float[Array, "... C"]:
    """The maximum over the points; the first of several has the derivative.

    The derivative of `jnp.max` divides by how many operands equal the maximum. In a
    compiled program both may come from different fusions: none is equal, and it is NaN.
    """
    place = jnp.argmax(jax.lax.stop_gradient(features), axis=-2, keepdims=True)
    chosen = jnp.arange(features.shape[-2])[:, None] == place
    return jnp.where(chosen, features, 0.0).sum(-2)


# Whenever a parameter is read, Flax traces its initialiser to compare shapes. These are
# traced once for each shape: a quarter of what tracing an adaptation took.
kernel_init = jax.jit(nn.linear.default_kernel_init, static_argnums=1)
bias_init = jax.jit(nn.initializers.zeros_init(), static_argnums=1)


def over_batch(fn: Callable[..., Any]) -> Callable[..., Any]:
    """A function of single clouds, mapped over all leading axes of its arguments. The
    first argument is a cloud ``(..., N, 3)``; all share its leading axes."""

    def mapped(cloud: Array, *others: Any) -> Any:
        batched = fn
        for _ in range(cloud.ndim - 2):
            batched = jax.vmap(batched)
        return batched(cloud, *others)

    return mapped


take = over_batch(lambda features, rows: features[rows])
"""Rows of ``(..., N, C)`` features at ``(..., M)`` or ``(..., M, k)`` indices."""


def matmul(x: Float[Array, "... C"], kernel: Float[Array, "C D"]) -> Array:
    """``x @ kernel`` with the leading axes made one: over several, the kernel's
    derivative takes XLA's CPU backend twice the time."""
    rows = x.reshape(-1, x.shape[-1]) @ kernel
    return rows.reshape(*x.shape[:-1], kernel.shape[-1])


class Dense(nn.Module):
    """A dense layer, which can be applied to the terms of a sum one by one: all but one
    of the calls with ``bias=False``."""

    features: int

    @nn.compact
    def __call__(
        self, x: Float[Array, "... C"], bias: bool = True
    ) -> Float[Array, "... D"]:
        kernel = self.param("kernel", kernel_init, (x.shape[-1], self.features))
        added = self.param("bias", bias_init, (self.features,))
        product = matmul(x, kernel)
        return product + added if bias else product


class Affine(nn.Module):
    """The kernel and the bias of a dense layer over several parts, for a caller who
    applies them (`joined_dense`)."""

    features: int
    kernel_init: nn.initializers.Initializer = kernel_init

    @nn.compact
    def __call__(
        self, parts: Sequence[Float[Array, "... _ _"]]
    ) -> tuple[Float[Array, "C D"], Float[Array, " D"]]:
        width = sum(part.shape[-1] for part in parts)
        kernel = self.param("kernel", self.kernel_init, (width, self.features))
        return kernel, self.param("bias", bias_init, (self.features,))


def joined_dense(
    parts: Sequence[Float[Array, "... _ _"]],
    kernel: Float[Array, "C D"],
    bias: Float[Array, " D"],
) -> Float[Array, "... N D"]:
    """A dense layer over the concatenation of several parts, never made; of a part with
    fewer points than the first, the product is repeated in place."""
    y, start, num_points = bias, 0, parts[0].shape[-2]
    for part in parts:
        product = matmul(part, kernel[start : start + part.shape[-1]])
        y = y + repeat_in_place(product, num_points // part.shape[-2])
        start += part.shape[-1]
    return y


class MLP(nn.Module):
    """Dense layers with a ReLU between them and none after the last. Several inputs are
    joined as in `joined_dense`. ``final_init`` is the last one's."""

    features: Sequence[int]
    final_init: nn.initializers.Initializer = kernel_init

    @nn.compact
    def __call__(self, *parts: Float[Array, "... _ _"]) -> Float[Array, "... N D"]:
        *hidden, last = self.features
        for i, width in enumerate(hidden):
            layer = Affine(width, name=f"dense_{i}")(parts)
            parts = (nn.relu(joined_dense(parts, *layer)),)
        layer = Affine(last, self.final_init, name=f"dense_{len(hidden)}")(parts)
        return joined_dense(parts, *layer)


class ResidualMLP(nn.Module):
    """Two layers and a linear shortcut (``MLP_Res`` of SnowflakeNet and CRA-PCN), which
    is one product with the first. Several inputs are joined as in `joined_dense`."""

    hidden: int
    features: int

    @nn.compact
    def __call__(self, *parts: Float[Array, "... _ _"]) -> Float[Array, "... N D"]:
        first = Affine(self.hidden, name="dense_0")(parts)
        shortcut = Affine(self.features, name="shortcut")(parts)
        pairs = zip(first, shortcut, strict=True)
        both = (jnp.concatenate(pair, axis=-1) for pair in pairs)
        y, x = jnp.split(joined_dense(parts, *both), [self.hidden], axis=-1)
        return Dense(self.features, name="dense_1")(nn.relu(y)) + x


class Conv(nn.Module):
    """`flax.linen.Conv`, "SAME" and without a bias, as a matrix product over windows:
    several times as fast on a CPU, with derivatives and a kernel for each frame."""

    features: int
    size: int
    strides: int = 1

    @nn.compact
    def __call__(self, x: Float[Array, "... H W C"]) -> Float[Array, "... H2 W2 D"]:
        shape = (self.size, self.size, x.shape[-1], self.features)
        kernel = self.param("kernel", kernel_init, shape)
        windows = _windows(x, self.size, self.strides)
        if kernels.on_gpu():
            # XLA of JAX 0.11.2 aborts where it fuses what joins them into the product.
            windows = jax.lax.optimization_barrier(windows)
        return matmul(windows, kernel.reshape(-1, self.features))


def _windows(x: Float[Array, "... H W C"], size: int, strides: int) -> Array:
    """Each window's pixels, row by row, joined in the channels."""
    padding = jax.lax.padtype_to_pads(
        x.shape[-3:-1], (size, size), (strides, strides), "SAME"
    )
    x = jnp.pad(x, [*[(0, 0)] * (x.ndim - 3), *padding, (0, 0)])
    height, width = (n - size + 1 for n in x.shape[-3:-1])
    shifted = [
        x[..., row : row + height : strides, column : column + width : strides, :]
        for row in range(size)
        for column in range(size)
    ]
    return jnp.concatenate(shifted, axis=-1)


def batch_norm(train: bool, name: str = "norm") -> nn.BatchNorm:
    """PyTorch's BatchNorm: momentum 0.1 there is 0.9 here."""
    return nn.BatchNorm(
        use_running_average=not train, momentum=0.9, epsilon=1e-5, name=name
    )


def repeat_in_place(x: Float[Array, "... N C"], times: int) -> Float[Array, "... M C"]:
    """Nearest upsampling of points: a, a, b, b, never a, b, a, b."""
    return x if times == 1 else jnp.repeat(x, times, axis=-2)


class SplitPoints(nn.Module):
    """Each point's feature turned into ``times`` children (a transposed convolution
    whose stride is its kernel)."""

    features: int
    times: int
    use_bias: bool = True

    @nn.compact
    def __call__(self, x: Float[Array, "... N C"]) -> Float[Array, "... M D"]:
        shape = (x.shape[-1], self.times, self.features)
        kernel = _Kernel(shape, name="dense")()
        y = matmul(x, kernel.reshape(x.shape[-1], -1))
        y = y.reshape(*x.shape[:-2], -1, self.features)
        if self.use_bias:
            y = y + self.param("bias", bias_init, (self.features,))
        return y


class _Kernel(nn.Module):
    """A kernel by itself; all its axes but the first are outputs."""

    shape: tuple[int, int, int]

    @nn.compact
    def __call__(self) -> Array:
        init = nn.initializers.lecun_normal(in_axis=0, out_axis=(1, 2))
        return self.param("kernel", init, self.shape)
