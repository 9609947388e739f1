"""A 3x3 convolution with ReLU of single 4x4 tiles, wherever in an image they lie.

As `winograd`, but the tiles come as a list of gathered 6x6 patches, so that a few of an image's
tiles cost no more than their share. The transforms are products with Lavin and Gray's
matrices along one axis after the other: products by zero too, though a third of the time of
written-out additions, for there is nothing that the compiler could fuse and compute again.
"""

import jax
import jax.numpy as jnp
from jax import lax

from jaxface._types import Array, Float
from jaxface.models.winograd import _INPUT, _OUTPUT

TILES_AT_ONCE = 48
"""tiles of one call; keeps what a call transforms within the processor's second-level cache"""


@jax.jit
def convolve_tiles(
    patches: Float[Array, "36 t i"], transformed: Float[Array, "36 i o"], bias: Float[Array, "o"]
) -> Float[Array, "16 t o"]:
    """Outputs of tiles, row by row of a tile, from their 6x6 patches.

    Args:
        patches: the inputs, one row and column more than the tile on every side.
        transformed: by `winograd.transformed_kernel`.
        bias: of the layer; the result is ``max(result + bias, 0)``.
    """
    _, tiles, channels = patches.shape
    outputs = transformed.shape[2]
    into = jnp.asarray(_INPUT, patches.dtype)
    back = jnp.asarray(_OUTPUT, patches.dtype)
    points = _both_axes(into, patches).reshape(36, tiles, channels)
    products = lax.dot_general(points, transformed, (((2,), (1,)), ((0,), (0,))))
    result = _both_axes(back, products)
    return jnp.maximum(result.reshape(16, tiles, outputs) + bias, 0)


def _both_axes(
    matrix: Float[Array, "a b"], values: Float[Array, "bb t n"]
) -> Float[Array, "a a m"]:
    """A matrix along both axes of tiles that are listed row by row."""
    points, size = matrix.shape
    first = (matrix @ values.reshape(size, -1)).reshape(points, size, -1)
    along = jnp.broadcast_to(matrix, (points, points, size))
    return lax.dot_general(along, first, (((2,), (1,)), ((0,), (0,))))
