"""Newton's method from face to face of the simplex, on products of the points alone.

Few points carry weight. Kept are their weights and, of all products ``p_jl . p_kl``, the rows of
those few: a step costs the same in any number of dimensions, and pricing all the points one small
product. For problems that share their points, whose products are then computed once.

The faces change as in Wolfe's method ("Finding the nearest point in a polytope", Math.
Programming 11, 1976): a full Newton step on the face, or as far as the first weight that becomes
zero, which leaves; where the face has no more to gain, the points of least price enter.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax.linalg import cholesky, triangular_solve

from jaxface._types import Array, Bool, Float, Int

SLOTS = 48
"""most points with weight"""
ENTER = 2
"""points that enter at once"""
STEPS = 160


class Products(NamedTuple):
    """A problem in products: ``||sum_k w_k p_kl - t_l||^2 = w^T G_l w - 2 b_l w + c_l``."""

    grams: Float[Array, "l k k"]
    """``p_jl . p_kl``; of points of order one"""
    inner: Float[Array, "l k"]
    """``p_kl . t_l``"""
    squares: Float[Array, " l"]
    """``||t_l||^2``"""


class _Face(NamedTuple):
    chosen: Int[Array, " s"]
    used: Bool[Array, " s"]
    weights: Float[Array, " s"]
    rows: Float[Array, "l s k"]
    """of the products with the points' differences from the target"""
    gap: Float[Array, ""]
    step: Int[Array, ""]
    done: Bool[Array, ""]


def newton_on_faces(
    problem: Products, start: Float[Array, " k"], tolerance: Float[Array, ""]
) -> tuple[Float[Array, " k"], Int[Array, ""]]:
    """Weights that minimise ``sum_l ||sum_k w_k p_kl - t_l||`` over the simplex, and steps taken.

    As exact as the products are: gaps of about ``1e-16 ||p||^2 / ||r||^2``. A term that vanishes
    at the solution, or a face of more than ``SLOTS`` points, ends the search before it has
    converged: certify what it returns.

    Args:
        problem: of at least ``SLOTS`` points.
        start: weights to start from; where more than half of ``SLOTS`` are positive, the nearest
            point instead.
        tolerance: relative gap to stop at.
    """
    grams, inner, squares = problem
    terms, count = inner.shape
    index = jax.lax.iota(jnp.int32, SLOTS)
    epsilon = float(jnp.finfo(grams.dtype).eps)
    own = jnp.diagonal(grams, axis1=1, axis2=2) - 2.0 * inner + squares[:, None]
    own = jnp.maximum(own, 0.0)
    largest = jnp.max(own, axis=1)

    def rows_of(points: Int[Array, " n"]) -> Float[Array, "l n k"]:
        inside = inner[:, points, None]
        return grams[:, points] - inside - inner[:, None, :] + squares[:, None, None]

    def norms_of(weights: Array, near: Array) -> tuple[Array, Array]:
        slopes = near @ weights
        return jnp.sqrt(jnp.maximum(slopes @ weights, epsilon**2 * largest)), slopes

    def reach(weights: Array, change: Array, used: Array) -> Array:
        """Step length at which each weight becomes zero."""
        falls = used & (change < 0)
        return jnp.where(falls, weights / jnp.where(falls, -change, 1.0), jnp.inf)

    def step(face: _Face) -> _Face:
        used, weights = face.used, face.weights
        near = face.rows[:, :, face.chosen] * (used[:, None] & used)
        norms, slopes = norms_of(weights, near)
        value = jnp.sum(norms)
        gradient = jnp.sum(slopes / norms[:, None], axis=0)
        major = jnp.tensordot(1.0 / norms, near, 1)
        if terms == 1:  # of the square, which is exact
            change = newton_direction(major, gradient, used)
        else:
            unit = slopes / norms[:, None] ** 1.5
            change = newton_direction(major - unit.T @ unit, gradient, used)
            # Far away a norm's parabola may lie below it; Weiszfeld's does not.
            new = weights + jnp.minimum(1.0, jnp.min(reach(weights, change, used))) * change
            worse = ~(jnp.sum(norms_of(new, near)[0]) <= value * (1.0 + 1e-14))
            change = jax.lax.cond(
                worse, lambda: newton_direction(major, gradient, used), lambda c=change: c
            )
        decrement = -(gradient @ change)
        finite = jnp.isfinite(decrement)
        at_zero = used & (weights <= 0) & (change < 0)
        lengths = reach(weights, change, used)
        shortest = jnp.min(lengths)
        blocked = shortest <= 1.0
        new = jnp.maximum(weights + jnp.minimum(shortest, 1.0) * change, 0.0)
        leaves = jnp.where(jnp.any(at_zero), at_zero, blocked & (lengths <= shortest))
        new = jnp.where(jnp.any(at_zero), weights, jnp.where(leaves, 0.0, new))
        new = jnp.where(finite, new / jnp.sum(new), weights)
        kept = jnp.where(finite, used & ~leaves, used)
        moved = face._replace(used=kept, weights=new, step=face.step + 1, done=~finite)
        settled = ~jnp.any(leaves) & (decrement <= 0.05 * face.gap)
        return jax.lax.cond(settled & finite, enter, lambda f: f, moved)

    def enter(face: _Face) -> _Face:
        """Price all the points; those of least price enter, or the search is done."""
        near = face.rows[:, :, face.chosen] * (face.used[:, None] & face.used)
        norms, _ = norms_of(face.weights, near)
        prices = jnp.tensordot(1.0 / norms, jnp.einsum("s,lsk->lk", face.weights, face.rows), 1)
        value = jnp.sum(norms)
        gap = value - jnp.min(prices)
        rounding = epsilon * jnp.sum(largest / norms)
        members = jnp.where(face.used, face.chosen, count)
        prices = prices.at[members].set(jnp.inf, mode="drop")
        prices, points = jax.lax.top_k(-prices, ENTER)
        free, slots = jax.lax.top_k(jnp.where(face.used, 0, SLOTS - index), ENTER)
        wanted = (-prices < value - 0.3 * gap) & (free > 0)
        still = ~wanted[0] & (gap > 0.5 * face.gap)
        done = still | (gap <= jnp.maximum(0.1 * tolerance * value, rounding))
        slots = jnp.where(wanted & ~done, slots, SLOTS)
        return face._replace(
            chosen=face.chosen.at[slots].set(points.astype(jnp.int32), mode="drop"),
            used=face.used.at[slots].set(True, mode="drop"),
            rows=face.rows.at[:, slots].set(rows_of(points), mode="drop"),
            gap=gap,
            done=done,
        )

    half = SLOTS // 2
    best, first = jax.lax.top_k(start, half)
    warm = jnp.sum(start > 0) <= half
    nearest = jnp.argmin(jnp.sum(jnp.sqrt(own), axis=0)).astype(jnp.int32)
    alone = (jax.lax.iota(jnp.int32, half) == 0).astype(start.dtype)
    weights = jnp.where(warm, jnp.maximum(best, 0.0), alone)
    first = jnp.where(warm, first.astype(jnp.int32), nearest)
    weights = jnp.pad(weights / jnp.sum(weights), (0, SLOTS - half))
    chosen = jnp.pad(first, (0, SLOTS - half))
    zero = jnp.asarray(0, jnp.int32)
    infinite = jnp.asarray(jnp.inf, grams.dtype)
    face = _Face(chosen, weights > 0, weights, rows_of(chosen), infinite, zero, jnp.asarray(False))
    found = jax.lax.while_loop(lambda f: ~f.done & (f.step < STEPS), step, face)
    members = jnp.where(found.used, found.chosen, count)
    whole = jnp.zeros_like(start).at[members].set(found.weights, mode="drop")
    return whole, found.step


def newton_direction(
    hessian: Float[Array, "s s"], gradient: Float[Array, " s"], used: Bool[Array, " s"]
) -> Float[Array, " s"]:
    """The minimum of a quadratic model over steps of the used weights that sum to zero."""
    index = jax.lax.iota(jnp.int32, len(used))
    eye = (index[:, None] == index).astype(hessian.dtype)
    ones = used.astype(hessian.dtype)
    mean = jnp.sum(jnp.diagonal(hessian) * ones) / jnp.sum(ones)
    # Steps sum to zero, so a multiple of 1 1^T changes nothing but the conditioning.
    hessian = (hessian + mean) * ones[:, None] * ones + eye * jnp.where(used, 1e-13 * mean, mean)
    factor = cholesky(hessian, symmetrize_input=False)
    sides = jnp.stack([-gradient * ones, ones], axis=1)
    half = triangular_solve(factor, sides, left_side=True, lower=True)
    solved = triangular_solve(factor, half, left_side=True, lower=True, transpose_a=True)
    return solved[:, 0] - jnp.sum(solved[:, 0]) / jnp.sum(solved[:, 1]) * solved[:, 1]
