"""A small vocabulary of functions that stay finite, in value and in derivative, everywhere."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Float, Int, Shaped


@partial(jax.custom_jvp, nondiff_argnums=(1, 2))
def safe_norm(
    x: Float[Array, "*batch d"], axis: int = -1, keepdims: bool = False
) -> Float[Array, "*batch"]:
    """Euclidean norm whose derivatives at the origin are zero instead of NaN.

    The input is scaled by its largest entry, so neither squares of tiny values underflow nor
    squares of huge ones overflow.
    """
    scale = jnp.max(jnp.abs(x), axis=axis, keepdims=True)
    scaled = x / jnp.where(scale == 0, 1.0, scale)
    norm = jnp.sqrt(jnp.sum(scaled * scaled, axis=axis, keepdims=True)) * scale
    return norm if keepdims else jnp.squeeze(norm, axis)


@safe_norm.defjvp
def _safe_norm_jvp(
    axis: int, keepdims: bool, primals: tuple[Array], tangents: tuple[Array]
) -> tuple[Array, Array]:
    (x,), (moved,) = primals, tangents
    norm = safe_norm(x, axis, True)
    slope = safe_divide(x, norm)
    change = jnp.sum(slope * moved, axis=axis, keepdims=True)
    return (norm, change) if keepdims else (jnp.squeeze(norm, axis), jnp.squeeze(change, axis))


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


LEVI_CIVITA = np.zeros((3, 3, 3))
"""the sign of the permutation (i, j, k), 0 where an index repeats"""
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    LEVI_CIVITA[_i, _j, _k], LEVI_CIVITA[_j, _i, _k] = 1.0, -1.0


def cross(a: Float[Array, "*batch 3"], b: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """Cross product, as one matrix of signs times the products of the entries.

    Differences of columns, as `jnp.cross` takes them, would each be compiled on their own.
    """
    products = a[..., :, None] * b[..., None, :]
    signs = jnp.asarray(LEVI_CIVITA.reshape(9, 3), products.dtype)
    return jnp.matmul(products.reshape(*products.shape[:-2], 9), signs, precision="highest")


def safe_sqrt(x: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Square root of ``max(x, 0)``; the derivative is zero for ``x <= 0``."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def running_count(flags: Shaped[Array, "*batch t"]) -> Int[Array, "*batch t"]:
    """How many flags (zeros and ones) are set up to and with each, along the last axis.

    Prefix sums of blocks of 128, of the blocks' sums, and so on, by a triangular matrix: XLA's own
    prefix sum is ten times slower on a CPU. Exact up to 2^24 flags, the integers of float32.
    """

    def summed(values: Array) -> Array:
        size = values.shape[-1]
        edges = [(0, 0)] * (values.ndim - 1)
        blocks = jnp.pad(values, [*edges, (0, -size % 128)])
        blocks = blocks.reshape(*values.shape[:-1], -1, 128)
        upper = jnp.triu(jnp.ones((128, 128), jnp.float32))
        within = jnp.matmul(blocks, upper, precision="highest")
        if within.shape[-2] > 1:
            sums = within[..., -1]
            within = within + (summed(sums) - sums)[..., None]
        return within.reshape(*values.shape[:-1], -1)[..., :size]

    return summed(flags.astype(jnp.float32)).astype(jnp.int32)


def all_finite(tree: Shaped[Array, "..."]) -> Array:
    """True where every floating-point leaf of a pytree is finite."""
    leaves = [
        x for x in jax.tree.leaves(tree) if jnp.issubdtype(jnp.asarray(x).dtype, jnp.floating)
    ]
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in leaves]))
