"""3x3 convolution by Winograd's minimal filtering F(4x4, 3x3), written for XLA's CPU compiler.

Lavin and Gray, "Fast Algorithms for Convolutional Neural Networks", CVPR 2016: an image is cut
into tiles of 4x4 outputs; input tiles (6x6) and kernels go through small linear maps, after which
the convolution is 36 matrix products, with a quarter of the multiplications of the direct sum.

Strips of tile rows are processed one after another, so that memory is bounded. XLA turns the
transforms into vector code for all cores only if it is given no reason not to:

- a slice at a place known at run time is fused into its readers, whose inner loops then load the
  place anew for every element;
- a concatenation becomes a branch for every element; so each map writes a new axis by
  broadcasting against columns of its matrix, which costs multiplications by zero and saves code;
- a map fused into the next is recomputed by every reader; and one fused into the write to a part of
  a larger array runs on a single core.

So each map along one axis is the branch of a condition that only we know to be true: nothing is
fused across it, and it is still shared among the cores.

The interpolation points along the tiles' first axis go several ways, from the strip to the outputs'
columns, and are joined last. What one way holds is nearer to the processor's caches; and products
that XLA computes on one core, as it does small ones, run side by side.

Kernels and buffers are computed from a zero that depends on the image: XLA would otherwise make
those of all layers at the start of a program, and hold them.
"""

import functools
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxface._types import Array, Bool, Float

TILE = 4
"""outputs of a tile along each axis"""

_PATCH = TILE + 2

# Interpolation points 0, 1, -1, 2, -2 and infinity (Lavin and Gray, section 4.3): G, B^T and A^T.
_KERNEL = np.array(
    [
        [1 / 4, 0, 0],
        [-1 / 6, -1 / 6, -1 / 6],
        [-1 / 6, 1 / 6, -1 / 6],
        [1 / 24, 1 / 12, 1 / 6],
        [1 / 24, -1 / 12, 1 / 6],
        [0, 0, 1],
    ]
)
_INPUT = np.array(
    [
        [4, 0, -5, 0, 1, 0],
        [0, -4, -4, 1, 1, 0],
        [0, 4, -4, -1, 1, 0],
        [0, -2, -1, 2, 1, 0],
        [0, 2, -1, -2, 1, 0],
        [0, 4, 0, -5, 0, 1],
    ]
)
_OUTPUT = np.array(
    [
        [1, 1, 1, 1, 1, 0],
        [0, 1, -1, 2, -2, 0],
        [0, 1, 1, 4, 4, 0],
        [0, 1, -1, 8, -8, 1],
    ]
)

_WAYS, _MANY_WAYS, _MANY = 2, 6, 256
"""ways that the points along an axis go, and how many from so many channels on: there six take a
tenth of the time less than two, in twice the time to compile"""

_TILES_AT_ONCE = 1024
"""tiles of a strip at most, as far as whole rows allow: enough work to be shared, and 36 * 1024
floats a channel, before the matrix products and after them"""


def winograd_conv3x3(
    x: Float[Array, "h w _"],
    kernel: Float[Array, "3 3 i o"],
    bias: Float[Array, "_"] | None = None,
    gate: Bool[Array, "h w _"] | None = None,
    transpose: bool = False,
    tiles_at_once: int = _TILES_AT_ONCE,
    transformed: Sequence[Float[Array, "p i o"]] = (),
) -> Float[Array, "h w _"]:
    """Correlation with a 3x3 kernel, zeros outside the image.

    In float32 the result differs from the exact one by about 1e-5 of its largest value, some ten
    times as much as the direct sum does.

    Args:
        x: the image.
        kernel: HWIO.
        bias: where given, the result is ``max(result + bias, 0)``.
        gate: where given, ``x`` counts only where this is true.
        transpose: compute the adjoint, from o channels to i.
        tiles_at_once: how many tiles are transformed at a time, if a row has no more.
        transformed: of the kernel, or, to ``transpose``, of that turned by 180 degrees
            (`transformed_kernel`); computed where it is empty.
    """
    height, width, channels = x.shape
    outputs = kernel.shape[2 if transpose else 3]
    columns, rows = -(-width // TILE), -(-height // TILE)
    # Rows of a strip that divide those of the image: a last strip that overhangs costs a copy.
    most = max(1, min(rows, tiles_at_once // columns))
    even = max(n for n in range(1, most + 1) if rows % n == 0)
    strips = rows // even if 2 * even > most else -(-rows // most)
    rows = -(-rows // strips)  # of a strip
    step = rows * TILE
    size = (step + 2, columns * TILE + 2, channels)
    # One row and column of zeros around, and what the last strip reads past the end.
    margin = ((1, strips * step + 1 - height), (1, size[1] - 1 - width), (0, 0))
    padded = jnp.pad(x, margin)
    padded_gate = None if gate is None else jnp.pad(gate, margin)
    zero = jnp.minimum(jnp.abs(x[0, 0, 0]), 0)
    # Transposing the kernel too would be fused into its transform, and read out of order there.
    points = tuple(transformed) or transformed_kernel(
        (kernel[::-1, ::-1] if transpose else kernel) + zero
    )
    contracted = ((2,), (2 if transpose else 1,))

    def apart(function: Callable[[Any], Array], value: Any) -> Array:
        shape = jax.eval_shape(function, value)
        # True of NaN as well.
        return lax.cond(
            ~(zero < -1), function, lambda _: jnp.zeros(shape.shape, shape.dtype), value
        )

    def strip_at(i: Array | int) -> Array:
        strip = lax.dynamic_slice(padded, (i * step, 0, 0), size)
        if padded_gate is None:
            return strip
        return jnp.where(lax.dynamic_slice(padded_gate, (i * step, 0, 0), size), strip, 0)

    def one_way(strip: Array, matrix: np.ndarray, kernels: Array) -> Array:
        along_y = apart(lambda strip: _transform_rows(strip, rows, matrix), strip)
        tiles = apart(lambda along_y: _transform_columns(along_y, columns), along_y)
        products = lax.dot_general(tiles, kernels, (contracted, ((0,), (0,))))
        return apart(_inverse_columns, products.reshape(-1, _PATCH, rows, columns, outputs))

    def finish(parts: list[Array]) -> Array:
        result = _inverse_rows(parts)
        return result if bias is None else jnp.maximum(result + bias, 0)

    def convolved(strip: Array) -> Array:
        matrices = np.split(_INPUT, len(points))
        parts = [one_way(strip, m, k) for m, k in zip(matrices, points, strict=True)]
        return apart(finish, parts)

    def body(i: Array, out: Array) -> Array:
        return lax.dynamic_update_slice(out, convolved(strip_at(i))[None], (i, 0, 0, 0, 0, 0))

    if strips == 1:
        out = convolved(strip_at(0))
    else:
        blank = jnp.full((strips, rows, TILE, columns, TILE, outputs), zero)
        out = lax.fori_loop(0, strips, body, blank)
    return out.reshape(strips * step, columns * TILE, outputs)[:height, :width]


def _column(matrix: np.ndarray, index: int, axis: int, ndim: int, like: Array) -> Array:
    """A column of a matrix along one axis of an array, to be multiplied by broadcasting."""
    shape = [1] * ndim
    shape[axis] = len(matrix)
    return jnp.asarray(matrix[:, index].reshape(shape), like.dtype)


@jax.jit
def transformed_kernel(kernel: Float[Array, "3 3 i o"]) -> tuple[Float[Array, "p i o"], ...]:
    """A kernel at each pair of interpolation points, ``G g G^T``, those of each way together."""
    ways = _MANY_WAYS if max(kernel.shape) >= _MANY else _WAYS
    return tuple(
        _total(
            _column(np.kron(rows, _KERNEL), 3 * y + x, 0, 3, kernel) * kernel[y, x]
            for y in range(3)
            for x in range(3)
        )
        for rows in np.split(_KERNEL, ways)
    )


def _transform_rows(
    strip: Float[Array, "h w i"], rows: int, matrix: np.ndarray
) -> Float[Array, "p r w i"]:
    """Rows of ``B^T`` along the first axis of overlapping tiles of six."""
    _, width, channels = strip.shape
    last = TILE * (rows - 1) + 1
    return _total(
        _column(matrix, y, 0, 4, strip)
        * lax.slice(strip, (y, 0, 0), (y + last, width, channels), (TILE, 1, 1))
        for y in range(_PATCH)
        if matrix[:, y].any()
    )


def _transform_columns(along_y: Float[Array, "p r w i"], columns: int) -> Float[Array, "q t i"]:
    """``B^T`` along the second axis; one matrix of tiles for each pair of points."""
    points, rows, _, channels = along_y.shape
    last = TILE * (columns - 1) + 1
    value = _total(
        _column(_INPUT, x, 1, 5, along_y)
        * lax.slice(along_y, (0, 0, x, 0), (points, rows, x + last, channels), (1, 1, TILE, 1))[
            :, None
        ]
        for x in range(_PATCH)
    )
    return value.reshape(points * _PATCH, rows * columns, channels)


def _inverse_columns(products: Float[Array, "p 6 r c o"]) -> Float[Array, "p r c 4 o"]:
    """``A^T`` along the tiles' second axis."""
    return _total(
        _column(_OUTPUT, x, 3, 5, products) * products[:, x, :, :, None] for x in range(_PATCH)
    )


def _inverse_rows(parts: Sequence[Float[Array, "p r c 4 o"]]) -> Float[Array, "r 4 c 4 o"]:
    """``A^T`` along the tiles' first axis, of all ways' points."""
    points = [point for part in parts for point in part]
    return _total(
        _column(_OUTPUT, y, 1, 5, point) * point[:, None] for y, point in enumerate(points)
    )


def _total(terms: Iterable[Array]) -> Array:
    return functools.reduce(operator.add, terms)
