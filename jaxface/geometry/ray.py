"""Where a viewing ray meets the plane of a triangle."""

import jax.numpy as jnp

from jaxface._numerics import above_rounding, cross, safe_divide
from jaxface._types import Array, Float


def pixel_rays(
    position: Float[Array, "*batch 2"], focal: Float[Array, ""], principal: Float[Array, "2"]
) -> Float[Array, "*batch 3"]:
    """Directions (camera frame, z = -1) through image positions (pixels, y down)."""
    offset = (position - principal) / focal
    return jnp.stack([offset[..., 0], -offset[..., 1], -jnp.ones_like(offset[..., 0])], axis=-1)


def ray_weights(
    direction: Float[Array, "*batch 3"], corners: Float[Array, "*batch 3 3"]
) -> Float[Array, "*batch 3"]:
    """Barycentric weights of the point where a ray from the origin meets a triangle's plane.

    Moeller & Trumbore, "Fast, minimum storage ray/triangle intersection", 1997. The weights are
    perspective-correct by construction, sum to one, and are differentiable in the ray and the
    corners with the triangle held fixed. A triangle seen edge-on (a determinant of zero, to within
    rounding) gives the weights (1, 0, 0) with a zero derivative.
    """
    a = corners[..., 0, :]
    edge1 = corners[..., 1, :] - a
    edge2 = corners[..., 2, :] - a
    p = cross(direction, edge2)
    lengths = [jnp.max(jnp.abs(v), axis=-1) for v in (direction, edge1, edge2)]
    size = lengths[0] * lengths[1] * lengths[2]
    determinant = above_rounding(jnp.sum(edge1 * p, axis=-1, keepdims=True), size)[..., 0]
    inverse = safe_divide(jnp.ones_like(determinant), determinant)
    w1 = -jnp.sum(a * p, axis=-1) * inverse
    w2 = -jnp.sum(direction * cross(a, edge1), axis=-1) * inverse
    return jnp.stack([1.0 - w1 - w2, w1, w2], axis=-1)
