"""A small vocabulary of functions that stay finite, in value and in derivative, everywhere."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Bool, Float, Int, PyTree, Shaped


@partial(jax.custom_jvp, nondiff_argnums=(1, 2))
def safe_norm(
    x: Float[Array, "*shape"], axis: int = -1, keepdims: bool = False
) -> Float[Array, "*reduced"]:
    """Euclidean norm whose derivatives at the origin are zero instead of NaN.

    The input is scaled by its largest entry, so neither squares of tiny values underflow nor
    squares of huge ones overflow.

    Args:
        x: values.
        axis: the one along which the norm is taken.
        keepdims: True leaves that axis with length 1, False takes it away.
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


def safe_normalize(x: Float[Array, "*shape"], axis: int = -1) -> Float[Array, "*shape"]:
    """``x / |x|``; the zero vector maps to zero with a zero derivative."""
    norm = safe_norm(x, axis=axis, keepdims=True)
    return x / jnp.where(norm == 0, 1.0, norm) * (norm > 0)


def safe_divide(
    numerator: Float[Array, "*#batch"], denominator: Float[Array, "*#batch"], fill: float = 0.0
) -> Float[Array, "*#batch"]:
    """``numerator / denominator``, and ``fill`` (derivative zero) where the denominator is 0.

    The shapes may differ, as long as they broadcast.
    """
    zero = denominator == 0
    return jnp.where(zero, fill, numerator / jnp.where(zero, 1.0, denominator))


LEVI_CIVITA = np.zeros((3, 3, 3))
"""the sign of the permutation (i, j, k), 0 where an index repeats"""
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    LEVI_CIVITA[_i, _j, _k], LEVI_CIVITA[_j, _i, _k] = 1.0, -1.0


def cross(a: Float[Array, "*#batch 3"], b: Float[Array, "*#batch 3"]) -> Float[Array, "*#batch 3"]:
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


def safe_arctan2(y: Float[Array, "*batch"], x: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Angle (radians) of the point (x, y); at the origin it is zero with a zero derivative."""
    origin = (x == 0) & (y == 0)
    return jnp.arctan2(jnp.where(origin, 0.0, y), jnp.where(origin, 1.0, x))


def above_rounding(
    total: Float[Array, "*batch d"], size: Float[Array, "*batch"]
) -> Float[Array, "*batch d"]:
    """``total``, or zero (with a zero derivative) where no more than rounding is left of it.

    What cancels in exact arithmetic leaves a last digit behind whose direction depends on the
    order of the sum, which the two modes of differentiation need not share.

    Args:
        total: sums, vectors along the last axis.
        size: sum of the magnitudes of the products that went into each.
    """
    limit = 16 * jnp.finfo(total.dtype).eps * jax.lax.stop_gradient(size)
    nothing = jnp.max(jnp.abs(total), axis=-1) <= limit
    return jnp.where(nothing[..., None], 0.0, total)


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


def all_finite(tree: PyTree) -> Bool[Array, ""]:
    """True where every floating-point leaf of a pytree is finite, and where there is none."""
    leaves = [
        x for x in jax.tree.leaves(tree) if jnp.issubdtype(jnp.asarray(x).dtype, jnp.floating)
    ]
    return jnp.all(jnp.array([jnp.all(jnp.isfinite(x)) for x in leaves], bool))
