"""Long columns to short ones with the same geometry: a square root of their Gram matrix.

Only distances within the span of some columns ``M`` (n, c) matter to a problem over their
combinations, and ``||M w|| = ||R w||`` for any ``R^T R = M^T M``. Forming ``M^T M`` squares the
condition number, and Householder's panels run at the speed of memory. The factor is therefore made
as Fukaya, Kannan, Nakatsukasa, Yamamoto and Yanagisawa do ("Shifted Cholesky QR for computing the
QR factorization of ill-conditioned matrices", SIAM J. Sci. Comput. 42, 2020): a rough factor
first, from a sample of the rows; then the Gram matrix of the well-conditioned ``M P``, in one pass
over ``M``. ``P`` is one of two:

- a rotation that puts the few longest directions first, and a scale for each (`_Turned`). The
  rotation is a product of few reflections and costs a fraction of the Gram matrix. What it leaves
  is as well-conditioned as the short directions are among themselves;
- where those are not, the inverse of the rough factor, shifted so that it exists (`_Divided`).

All of it is in double precision: the result then stands for single-precision columns to their
last digit, which the shift of the target below would otherwise lose. Blocks of rows are taken by
as many threads as there are processors, each with one thread of BLAS: those of OpenBLAS wait for
each other in a loop, which on a busy machine costs several times the work itself.
"""

from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from threadpoolctl import threadpool_limits

from jaxface._machine import usable_cores
from jaxface._types import Array, Float

SHIFT = 1e-12
"""what is added to the sample's Gram matrix, as a share of its trace"""
TRUSTED = 1e4
"""the sample's factor serves while it makes no combination longer than the root of this"""
SPREAD = 1e3
"""ratio of lengths that is left to the Gram matrix: its square costs that many of 16 digits"""
REFLECTIONS = 0.2
"""share of the columns up to which turning is cheaper than dividing"""


def triangular_factor(
    blocks: Callable[[int | None], Iterable[Float[np.ndarray, "c rows"]]],
    columns: int,
    passes: int = 4,
) -> Float[np.ndarray, "c c"]:
    """``R`` with ``R^T R = M^T M`` for a tall ``M`` that is read in blocks of rows.

    Memory beyond one block is a few ``(c, c)`` matrices of doubles. Lengths ``||R w||`` have
    relative errors of 1e-10 or less, or absolute ones of about 1e-16 of the longest column.

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
    with threadpool_limits(1, "blas"):
        sample = _gram(blocks(6 * columns), columns, lambda block: block)
        form = _turned(sample) or _Divided(_shifted(sample))
        for _ in range(passes):
            gram = form.scaled(_gram(blocks(None), columns, form.evened))
            if scipy.linalg.norm(gram, 2) <= TRUSTED:
                break
            triangle: Any = np.linalg.qr(form.restored(_shifted(gram)), mode="r")
            form = _Divided(triangle)
        return form.restored(_root(gram))


class _Turned(NamedTuple):
    """Columns turned by ``Q = I - U V^T`` (Schreiber and Van Loan 1989) and scaled: ``M Q / d``."""

    reflectors: Float[np.ndarray, "c r"]
    returns: Float[np.ndarray, "c r"]
    scales: Float[np.ndarray, " c"]

    def evened(self, block: Float[np.ndarray, "c rows"]) -> Float[np.ndarray, "c rows"]:
        """Rows of ``M Q``, transposed."""
        block -= self.returns @ (self.reflectors.T @ block)
        return block

    def scaled(self, gram: Float[np.ndarray, "c c"]) -> Float[np.ndarray, "c c"]:
        """That of ``M Q / d``: rounding is relative to the columns, before as after."""
        return gram / self.scales[:, None] / self.scales

    def restored(self, root: Float[np.ndarray, "m c"]) -> Float[np.ndarray, "m c"]:
        """``root d Q^T``."""
        root = root * self.scales
        return root - (root @ self.returns) @ self.reflectors.T


class _Divided(NamedTuple):
    """Columns divided by an upper triangular matrix: ``M S^-1``."""

    factor: Float[np.ndarray, "c c"]

    def evened(self, block: Float[np.ndarray, "c rows"]) -> Float[np.ndarray, "c rows"]:
        """Rows of ``M S^-1``, transposed."""
        divide: Any = scipy.linalg.get_blas_funcs("trsm", dtype=np.float64)
        return divide(1.0, self.factor, block.T, side=1, overwrite_b=1).T

    def scaled(self, gram: Float[np.ndarray, "c c"]) -> Float[np.ndarray, "c c"]:
        """As it is."""
        return gram

    def restored(self, root: Float[np.ndarray, "m c"]) -> Float[np.ndarray, "m c"]:
        """``root S``."""
        return root @ self.factor


def _turned(gram: Float[np.ndarray, "c c"]) -> _Turned | None:
    """The longest directions first, until the rest differ little in length; None if many do."""
    values, vectors = scipy.linalg.eigh(gram, check_finite=False)
    lengths = np.sqrt(np.maximum(values[::-1], 0.0))
    # An eigenvalue below this is the rounding of the sample's own Gram matrix.
    least = max(float(lengths[-1]), 1e-7 * float(lengths[0]))
    count = int(np.sum(lengths > SPREAD * least))
    if not 0 < count <= REFLECTIONS * len(gram):
        return None
    reflect: Any = scipy.linalg.get_lapack_funcs("geqrf", dtype=np.float64)
    raw, tau, *_ = reflect(vectors[:, ::-1][:, :count])
    reflectors = np.tril(raw, -1)
    np.fill_diagonal(reflectors, 1.0)
    # T^-1 + T^-T = U^T U (Puglisi 1992)
    inverse = np.triu(reflectors.T @ reflectors, 1) + np.diag(1.0 / tau)
    triangle = scipy.linalg.solve_triangular(inverse, np.eye(count))
    return _Turned(reflectors, reflectors @ triangle.T, np.maximum(lengths, lengths[count]))


def _gram(
    blocks: Iterable[np.ndarray], columns: int, even: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """The Gram matrix of evened blocks; added in their order, so that threads change no digit."""

    def product(block: np.ndarray) -> np.ndarray:
        block = even(block)
        return block @ block.T

    total = np.zeros((columns, columns))
    threads = usable_cores()
    at_work: deque[Future[np.ndarray]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        for block in blocks:
            at_work.append(pool.submit(product, block))
            if len(at_work) > threads:
                total += at_work.popleft().result()
        for future in at_work:
            total += future.result()
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
