"""3x3 convolution with few input channels: a sum of nine shifted images, for XLA's CPU compiler.

Winograd's transforms and a matrix product over one or two channels both waste their work; a sum
of shifted copies fuses into one pass that writes each response once. The adjoint goes the other
way: one matrix product to nine maps, which are shifted and added.
"""

import functools
import operator
from collections.abc import Iterable

import jax.numpy as jnp

from jaxface._types import Array, Float


def shifted_sum_conv3x3(
    x: Float[Array, "h w i"], kernel: Float[Array, "3 3 i o"], bias: Float[Array, "o"] | None = None
) -> Float[Array, "h w o"]:
    """Correlation with a 3x3 kernel, zeros outside; with a bias, ``max(result + bias, 0)``."""
    height, width, channels = x.shape
    padded = jnp.pad(x, ((1, 1), (1, 1), (0, 0)))
    y = _total(
        padded[i : i + height, j : j + width, c, None] * kernel[i, j, c]
        for i in range(3)
        for j in range(3)
        for c in range(channels)
    )
    return y if bias is None else jnp.maximum(y + bias, 0)


def shifted_sum_conv3x3_transpose(
    y: Float[Array, "h w o"], kernel: Float[Array, "3 3 i o"]
) -> Float[Array, "h w i"]:
    """The adjoint of the convolution, from o channels to i."""
    height, width, _ = y.shape
    inputs, outputs = kernel.shape[2:]
    maps = y.reshape(height * width, outputs) @ kernel.reshape(9 * inputs, outputs).T
    maps = jnp.pad(maps.reshape(height, width, 3, 3, inputs), ((1, 1), (1, 1), *((0, 0),) * 3))
    return _total(
        maps[2 - i : 2 - i + height, 2 - j : 2 - j + width, i, j]
        for i in range(3)
        for j in range(3)
    )


def _total(terms: Iterable[Array]) -> Array:
    return functools.reduce(operator.add, terms)
