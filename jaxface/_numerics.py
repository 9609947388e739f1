"""A small vocabulary of functions that stay finite, in value and in derivative, everywhere."""

import jax
import jax.numpy as jnp

from jaxface._types import Array, Float, Shaped


def safe_norm(
    x: Float[Array, "*batch d"], axis: int = -1, keepdims: bool = False
) -> Float[Array, "*batch"]:
    """Euclidean norm whose derivative at the origin is zero instead of NaN.

    The input is scaled by its largest entry, so neither squares of tiny values underflow nor
    squares of huge ones overflow.
    """
    scale = jax.lax.stop_gradient(jnp.max(jnp.abs(x), axis=axis, keepdims=True))
    zero = scale == 0
    scaled = x / jnp.where(zero, 1.0, scale)
    squared = jnp.sum(scaled * scaled, axis=axis, keepdims=True)
    norm = jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, squared)) * scale)
    return norm if keepdims else jnp.squeeze(norm, axis)


def safe_normalize(x: Float[Array, "*batch d"], axis: int = -1) -> Float[Array, "*batch d"]:
    """``x / |x|``; the zero vector maps to zero with a zero derivative."""
    norm = safe_norm(x, axis=axis, keepdims=True)
    return x / jnp.where(norm == 0, 1.0, norm) * (norm > 0)


def safe_divide(
    numerator: Float[Array, "*batch"], denominator: Float[Array, "*batch"], fill: float = 0.0
) -> Float[Array, "*batch"]:
    """``numerator / denominator``, and ``fill`` (derivative zero) where the denominator is 0."""
    zero = denominator == 0
    return jnp.where(zero, fill, numerator / jnp.where(zero, 1.0, denominator))


def safe_sqrt(x: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Square root of ``max(x, 0)``; the derivative is zero for ``x <= 0``."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def all_finite(tree: Shaped[Array, "..."]) -> Array:
    """True where every floating-point leaf of a pytree is finite."""
    leaves = [
        x for x in jax.tree.leaves(tree) if jnp.issubdtype(jnp.asarray(x).dtype, jnp.floating)
    ]
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in leaves]))
