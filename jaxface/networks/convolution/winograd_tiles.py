"""A 3x3 convolution with ReLU of single 4x4 tiles, wherever in an image they lie.

As `winograd`, but the tiles come as a list of gathered 6x6 patches, so that a few of an image's
tiles cost no more than their share; and by NumPy, on the host, where the patches are gathered.
There each transform is one product a tile with the Kronecker product of Lavin and Gray's matrices:
three times the multiplications of one axis after the other, at more than three times the speed,
for a product over six numbers waits for memory.
"""

import math

import numpy as np

from jaxface._types import Float
from jaxface.networks.convolution.winograd import _INPUT, _OUTPUT

_INTO = np.kron(_INPUT, _INPUT).astype(np.float32)
# The last column adds the bias, which lies behind the 36 products.
_BACK = np.pad(np.kron(_OUTPUT, _OUTPUT), ((0, 0), (0, 1)), constant_values=1).astype(np.float32)


def tiles_at_once(inputs: int, outputs: int) -> int:
    """Tiles of one call: what it transforms stays in a processor's second-level cache.

    With 128 channels as many as OpenBLAS multiplies as they lie, up to a million multiplications.
    Wider layers' kernels are larger than that cache; there more tiles share a kernel's reading.
    """
    widest = max(inputs, outputs)
    return 7680 // widest if widest <= 128 else 240


def convolve_tiles(
    patches: Float[np.ndarray, "t 36 i"],
    transformed: Float[np.ndarray, "36 i o"],
    bias: Float[np.ndarray, "o"],
    out: Float[np.ndarray, "t p o"],
    memory: tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]],
    pooling: str | None = None,
) -> None:
    """Write the outputs of tiles, row by row of a tile, made from their 6x6 patches.

    Args:
        patches: the inputs, one row and column more than the tile on every side; overwritten if
            they lie in the first memory, as they may.
        transformed: by `winograd.transformed_kernel`.
        bias: of the layer; the result is ``max(result + bias, 0)``.
        out: the result, 16 outputs a tile, or 4 pooled ones.
        memory: two pieces of ``37 t max(i, o)`` numbers, to work in.
        pooling: of the outputs' 2x2 cells, as of `features.pool`; by default none.
    """
    tiles, _, inputs = patches.shape
    outputs = len(bias)
    points = piece(memory[1], tiles, 36, inputs)
    products = piece(memory[0], tiles, 37, outputs)
    sums = piece(memory[1], tiles, 16, outputs)
    np.matmul(_INTO, patches, out=points)
    np.matmul(points.swapaxes(0, 1), transformed, out=products[:, :36].swapaxes(0, 1))
    products[:, 36] = bias
    np.matmul(_BACK, products, out=sums)
    if pooling is None:
        np.maximum(sums, 0, out=out)
        return
    np.maximum(sums, 0, out=sums)
    cells = sums.reshape(tiles, 2, 2, 2, 2, outputs)
    both = np.maximum if pooling == "max" else np.add
    halves = both(cells[:, :, 0], cells[:, :, 1], out=cells[:, :, 0])
    pooled = out.reshape(tiles, 2, 2, outputs)
    both(halves[:, :, :, 0], halves[:, :, :, 1], out=pooled)
    if pooling == "average":
        pooled *= 0.25


def piece(memory: Float[np.ndarray, "m"], *shape: int) -> Float[np.ndarray, "..."]:
    """The first of a piece of memory's numbers, as an array of a shape."""
    return memory[: math.prod(shape)].reshape(shape)
