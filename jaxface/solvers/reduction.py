"""Long columns to short ones with the same geometry: the triangular factor of a QR decomposition.

Only distances within the span of some columns ``M`` (n, c) matter to a problem over their
combinations, and ``||M w|| = ||R w||`` for any ``R^T R = M^T M``. Forming ``M^T M`` squares the
condition number, and Householder's panels run at the speed of memory. The factor is therefore made
as Fukaya, Kannan, Nakatsukasa, Yamamoto and Yanagisawa do ("Shifted Cholesky QR for computing the
QR factorization of ill-conditioned matrices", SIAM J. Sci. Comput. 42, 2020): a rough factor ``S``
first, from a sample of the rows, shifted so that it exists; then the Gram matrix of the
well-conditioned ``M S^-1``, in one pass over ``M``. All of it is in double precision: the result
then stands for single-precision columns to their last digit, which the shift of the target below
would otherwise lose.
"""

from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from jaxface._types import Array, Float

SHIFT = 1e-12
"""what is added to the sample's Gram matrix, as a share of its trace"""
TRUSTED = 1e4
"""the sample's factor serves while it makes no combination longer than the root of this"""


def triangular_factor(
    blocks: Callable[[int | None], Iterable[Float[np.ndarray, "c rows"]]],
    columns: int,
    passes: int = 4,
) -> Float[np.ndarray, "m c"]:
    """``R`` with ``R^T R = M^T M`` for a tall ``M`` that is read in blocks of rows.

    Memory beyond one block is a few ``(c, c)`` matrices of doubles. ``R`` is upper triangular, or
    another square root where ``M`` lacks rank.

    Args:
        blocks: ``blocks(None)`` yields all rows of ``M`` in transposed blocks of doubles, which
            may be overwritten; ``blocks(count)`` about ``count`` rows, evenly spread, scaled to
            stand for all of them.
        columns: ``c``.
        passes: most passes over all rows; more than one is needed only where the sample of
            rows misleads.

    Raises:
        ValueError: an entry is not finite.
    """
    factor = _shifted(_gram(blocks(6 * columns), columns, None))
    for _ in range(passes):
        gram = _gram(blocks(None), columns, factor)
        if np.linalg.norm(gram, 2) <= TRUSTED:
            break
        factor = _shifted(gram) @ factor
    return _root(gram) @ factor


def _gram(blocks: Iterable[np.ndarray], columns: int, factor: np.ndarray | None) -> np.ndarray:
    total = np.zeros((columns, columns))
    divide: Any = scipy.linalg.get_blas_funcs("trsm", dtype=np.float64)
    for block in blocks:
        if factor is not None:  # rows of M S^-1, transposed
            block = divide(1.0, factor, block.T, side=1, overwrite_b=1).T
        total += block @ block.T
    if not np.all(np.isfinite(total)):
        raise ValueError("the columns hold NaN or infinite entries; they must be finite")
    return total


def _shifted(gram: np.ndarray) -> np.ndarray:
    """Upper Cholesky factor of a Gram matrix, lifted until it is positive definite."""
    shift = SHIFT * max(float(np.trace(gram)), np.finfo(float).tiny)
    while True:
        try:
            return scipy.linalg.cholesky(gram + shift * np.eye(len(gram)), check_finite=False)
        except scipy.linalg.LinAlgError:
            shift *= 100.0


def _root(gram: np.ndarray) -> np.ndarray:
    """A square root of a positive semidefinite matrix, triangular where it is definite."""
    try:
        return scipy.linalg.cholesky(gram, check_finite=False)
    except scipy.linalg.LinAlgError:
        values, vectors = scipy.linalg.eigh(gram, check_finite=False)
        return np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T


def reduced(
    columns: Float[Array, "k n"], target: Float[Array, " n"]
) -> tuple[Float[Array, "k m"], Float[Array, " m"]]:
    """Short columns and a short target, ``m <= k + 1``, with the same distances between them.

    The form of `triangular_factor` for arrays in memory: traceable, and under ``vmap`` over
    targets the columns are factorised once. Columns of at most ``k + 1`` entries are passed on.
    Call within double precision. Not meant to be differentiated through.
    """
    count, size = columns.shape
    if size <= count + 1:
        return columns, target
    eye = jnp.eye(count, dtype=columns.dtype)
    even, factor = columns, eye
    for share in (1e2 * SHIFT, SHIFT):  # the second finds what the first hid
        gram = even @ even.T
        tiny = jnp.finfo(columns.dtype).tiny
        lower = jnp.linalg.cholesky(gram + (share * jnp.trace(gram) + tiny) * eye)
        even = jax.lax.linalg.triangular_solve(lower, even, left_side=True, lower=True)
        factor = factor @ lower
    values, vectors = jnp.linalg.eigh(even @ even.T)
    # What two shifts leave small is rounding, of columns without full rank.
    usable = values > 1e-6 * values[-1]
    roots = jnp.sqrt(jnp.where(usable, values, 0.0))
    basis = jnp.where(usable, 1.0 / jnp.where(usable, roots, 1.0), 0.0)[:, None] * vectors.T
    short = factor @ (vectors * roots)
    inside = basis @ (even @ target)
    rest = target - (basis.T @ inside) @ even
    more = basis @ (even @ rest)  # a second sweep of Gram-Schmidt
    rest = rest - (basis.T @ more) @ even
    zero = jnp.zeros((count, 1), columns.dtype)
    return (
        jnp.concatenate([short, zero], axis=1),
        jnp.append(inside + more, jnp.linalg.norm(rest)),
    )
