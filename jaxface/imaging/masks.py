"""Masks of an image: filled polygons, erosion and dilation by a disc, soft edges."""

import math
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Bool, Float

Values = TypeVar("Values", Array, np.ndarray)


def smoothstep(x: Values, start: float | Values, stop: float | Values) -> Values:
    """0 up to ``start``, 1 from ``stop``, the cubic ``t^2 (3 - 2 t)`` between (slope 0 at both).

    Args:
        x: of any shape; an array of NumPy stays one.
        start: of a shape that broadcasts with that of ``x``.
        stop: likewise.
    """
    t = ((x - start) / (stop - start)).clip(0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def fill_polygon(points: Float[Array, "k 2"], height: int, width: int) -> Bool[Array, "h w"]:
    """Pixels whose centre lies inside a closed polygon, by the even-odd rule.

    Args:
        points: corners (x, y) in pixels, in order; they may lie outside the image.
        height: rows of the image.
        width: columns of the image.
    """
    x = jnp.arange(width, dtype=points.dtype) + 0.5
    y = jnp.arange(height, dtype=points.dtype)[:, None] + 0.5
    ends = jnp.roll(points, -1, axis=0)
    # Half-open in y, so a corner that lies exactly on a row counts once.
    crosses = (points[:, 1] <= y) != (ends[:, 1] <= y)
    rise = ends[:, 1] - points[:, 1]
    along = (y - points[:, 1]) / jnp.where(rise == 0, 1.0, rise)
    crossing = jnp.where(crosses, points[:, 0] + along * (ends[:, 0] - points[:, 0]), jnp.inf)
    left_of = jnp.sum(crossing[:, None, :] <= x[:, None], axis=-1)
    return left_of % 2 == 1


def distance_to(mask: Bool[Array, "h w"], limit: int) -> Float[Array, "h w"]:
    """Euclidean distance (px) from each pixel's centre to the nearest True one, at most ``limit``.

    Exact within the limit. The squared distance is separable (Felzenszwalb and Huttenlocher,
    "Distance transforms of sampled functions", 2012); each of the two passes tries only the
    ``limit`` neighbours on either side that can matter. The space beyond the image counts as False.

    Raises:
        ValueError: ``limit`` is not a positive whole number.
    """
    if int(limit) != limit or limit < 1:
        raise ValueError(f"limit is {limit}; it needs a whole number of pixels, 1 or more")
    limit = int(limit)

    def lower_envelope(squared: Array, axis: int) -> Array:
        margin = [(0, 0), (0, 0)]
        margin[axis] = (limit, limit)
        padded = jnp.pad(squared, margin, constant_values=limit * limit)

        def nearer(step: Array, best: Array) -> Array:
            shifted = jax.lax.dynamic_slice_in_dim(padded, step, squared.shape[axis], axis)
            return jnp.minimum(best, shifted + (step - limit) ** 2)

        return jax.lax.fori_loop(0, 2 * limit + 1, nearer, squared)

    squared = jnp.where(mask, 0, limit * limit).astype(jnp.int32)
    squared = lower_envelope(lower_envelope(squared, 1), 0)
    return jnp.sqrt(squared.astype(jnp.result_type(float)))


def dilate(mask: Bool[Array, "h w"], radius: float) -> Bool[Array, "h w"]:
    """Grow a mask by a disc: True where a True pixel's centre is within ``radius`` px.

    Raises:
        ValueError: ``radius`` is negative.
    """
    if radius < 0:
        raise ValueError(f"radius is {radius}; it needs 0 px or more")
    return mask if radius < 1 else distance_to(mask, int(radius) + 1) <= radius


def erode(mask: Bool[Array, "h w"], radius: float) -> Bool[Array, "h w"]:
    """Shrink a mask by a disc; the border of the image does not eat into it.

    Raises:
        ValueError: ``radius`` is negative.
    """
    return ~dilate(~mask, radius)


def feather(mask: Bool[Array, "h w"], width: float) -> Float[Array, "h w"]:
    """Soft edge inside a mask: 0 outside, rising smoothly to 1 at ``width`` px from its edge.

    Raises:
        ValueError: ``width`` is negative.
    """
    if width < 0:
        raise ValueError(f"width is {width}; it needs 0 px or more")
    if width == 0:
        return mask.astype(jnp.result_type(float))
    # A pixel's centre is half a pixel from the edge between it and a neighbour outside.
    limit = math.ceil(width) + 1
    return smoothstep(distance_to(~mask, limit) - 0.5, 0.0, width) * mask
