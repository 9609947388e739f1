"""The layers that BlazeFace and the face mesh are made of: convolutions and residual blocks.

Bazarevsky et al., "BlazeFace: Sub-millisecond Neural Face Detection on Mobile GPUs", 2019,
section 3. Features are (height, width, channels); batches come from ``jax.vmap``.
"""

import functools
from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Float


class Convolution(eqx.Module):
    """A convolution with TensorFlow's ``SAME`` padding, and its activation."""

    kernel: Float[Array, "k k i o"]
    bias: Float[Array, "o"]
    slope: Float[Array, "#o"]
    """factor of negative outputs: 0 is a ReLU, learnt is a PReLU, 1 is no activation"""
    stride: int = eqx.field(static=True)

    def __call__(self, x: Float[Array, "h w i"]) -> Float[Array, "h2 w2 o"]:
        """Convolve, add the bias and activate."""
        size = self.kernel.shape[0]
        if size == self.stride == x.shape[0]:
            padding = (0, 0)
        else:
            padding = same_padding(x.shape[0], size, self.stride)
        y = jax.lax.conv_general_dilated(
            x[None],
            self.kernel.astype(x.dtype),
            (self.stride, self.stride),
            (padding, padding),
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
        )[0]
        return leaky(y + self.bias, self.slope)


class ResidualBlock(eqx.Module):
    """Depthwise then pointwise convolution, added to the input, then activated.

    Where the block halves the resolution the input is max-pooled first, and where it adds
    channels the input is filled up with zeros.
    """

    depthwise: Float[Array, "k k 1 i"]
    depthwise_bias: Float[Array, "i"]
    pointwise: Float[Array, "1 1 i o"]
    bias: Float[Array, "o"]
    slope: Float[Array, "#o"]
    stride: int = eqx.field(static=True)

    def __call__(self, x: Float[Array, "h w i"]) -> Float[Array, "h2 w2 o"]:
        """Apply the block."""
        y = depthwise_convolution(x, self.depthwise[:, :, 0], self.stride) + self.depthwise_bias
        y = y @ self.pointwise[0, 0] + self.bias
        if self.stride == 2:
            height, width, channels = x.shape
            x = jnp.max(x.reshape(height // 2, 2, width // 2, 2, channels), axis=(1, 3))
        x = jnp.pad(x, ((0, 0), (0, 0), (0, y.shape[-1] - x.shape[-1])))
        return leaky(x + y, self.slope)


def leaky(x: Float[Array, "*shape o"], slope: Float[Array, "#o"]) -> Float[Array, "*shape o"]:
    """``x`` where positive and ``slope * x`` elsewhere, per channel."""
    return jnp.where(x > 0, x, slope * x)


def same_padding(size: int, kernel: int, stride: int) -> tuple[int, int]:
    """Zeros before and after an axis in TensorFlow's ``SAME`` scheme (the odd one goes after)."""
    total = max((-(-size // stride) - 1) * stride + kernel - size, 0)
    return total // 2, total - total // 2


def depthwise_convolution(
    x: Float[Array, "h w c"], kernel: Float[Array, "k k c"], stride: int
) -> Float[Array, "h2 w2 c"]:
    """One small filter per channel, ``SAME`` padding.

    A sum of shifted products: XLA fuses it into one loop, where its grouped convolution is
    several times slower on a CPU.
    """
    height, width, _ = x.shape
    size = kernel.shape[0]
    x = jnp.pad(x, (same_padding(height, size, stride), same_padding(width, size, stride), (0, 0)))
    rows, columns = -(-height // stride), -(-width // stride)
    products = (
        kernel[i, j]
        * x[i : i + stride * (rows - 1) + 1 : stride, j : j + stride * (columns - 1) + 1 : stride]
        for i in range(size)
        for j in range(size)
    )
    return functools.reduce(jnp.add, products)


def chain(layers: tuple[Convolution | ResidualBlock, ...], x: Float[Array, "h w i"]) -> Array:
    """Apply layers one after the other."""
    for layer in layers:
        x = layer(x)
    return x


def read_chain(
    arrays: Mapping[str, np.ndarray],
    prefix: str,
    halving: tuple[int, ...] = (),
    linear: tuple[int, ...] = (),
) -> tuple[Convolution | ResidualBlock, ...]:
    """Layers stored under ``prefix/0/...``, ``prefix/1/...`` as float32.

    Args:
        arrays: the weights by name.
        prefix: where the chain is.
        halving: indices of the layers with stride 2.
        linear: indices of the layers without an activation.

    Raises:
        ValueError: there is no layer under the prefix.
    """
    layers = []
    while any(name.startswith(f"{prefix}/{len(layers)}/") for name in arrays):
        index = len(layers)
        here = f"{prefix}/{index}/"
        weights = {
            name.removeprefix(here): jax.device_put(np.asarray(array, np.float32))
            for name, array in arrays.items()
            if name.startswith(here)
        }
        slope = np.full(1, 1.0 if index in linear else 0.0, np.float32)
        weights.setdefault("slope", jax.device_put(slope))
        layer = ResidualBlock if "depthwise" in weights else Convolution
        layers.append(layer(**weights, stride=2 if index in halving else 1))
    if not layers:
        raise ValueError(f"the weights have no layer {prefix}/0; they hold {sorted(arrays)[:5]}...")
    return tuple(layers)
