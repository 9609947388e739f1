"""Vectors as three rows of numbers, one number a texel.

Separate rows, not one array: joining rows would keep XLA from vectorising what made them.
"""

import jax
import jax.numpy as jnp

from jaxface._types import Array, Float

Row = Float[Array, "n"]
Vector = tuple[Row, Row, Row]


def dot(a: Vector, b: Vector) -> Row:
    """Inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """Vector product."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def unit(a: Vector) -> Vector:
    """The vector at length 1."""
    inverse = jax.lax.rsqrt(jnp.maximum(dot(a, a), 1e-12))
    return (a[0] * inverse, a[1] * inverse, a[2] * inverse)
