"""Newton's method along the central path for ``min sum_l ||sum_k w_k p_kl||`` over the simplex.

The slow and sure method, for what the primal-dual one leaves: that takes full steps, and where a
residual vanishes at a solution with no weight at zero it can go round in circles. Here a norm is
the height of a second-order cone, with the barrier ``-log(t^2 - ||r||^2)``, and a weight has
``-log w``. For a multiplier ``mu`` the heights are known, ``t = mu + sqrt(mu^2 + ||r||^2)``, and
what is left is a function of the weights that is self-concordant, so that a Newton step shortened
to ``1 / (1 + decrement)`` always descends and never leaves the simplex (Nesterov and Nemirovskii,
"Interior-point polynomial algorithms in convex programming", 1994; Boyd and Vandenberghe, *Convex
Optimization*, section 11.5). ``y_l = r_l / t_l`` is a dual vector: the gap is ``mu (2 l + k)``.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax.linalg import cholesky, triangular_solve

from jaxface._types import Array, Bool, Float, Int
from jaxface.solvers.simplex.certificate import residuals

SHRINKS = 0.2
"""from one multiplier to the next"""


class _Path(NamedTuple):
    w: Float[Array, " k"]
    mu: Float[Array, ""]
    bound: Float[Array, ""]
    dual: Float[Array, "l m"]
    """of the best bound"""
    step: Int[Array, ""]
    done: Bool[Array, ""]


def central_path(
    points: Float[Array, "k l m"],
    tolerance: Float[Array, ""],
    floor: Float[Array, ""],
    *,
    steps: int = 600,
) -> tuple[Float[Array, " k"], Float[Array, "l m"], Int[Array, ""]]:
    """Minimise from equal weights until the gap is closed or rounding ends the progress.

    Relative gaps reach about 1e-9 where a residual vanishes; `polish` brings the last digits.

    Args:
        points: of order one.
        tolerance: stop at this gap, relative to the objective.
        floor: stop at this objective, which counts as zero.
        steps: greatest number of Newton steps.

    Returns:
        Weights (positive, sum one), dual vectors (in the unit ball), steps taken.
    """
    count, terms, _ = points.shape
    layers = points.transpose(1, 0, 2)
    grams = layers @ layers.transpose(0, 2, 1)
    index = jax.lax.iota(jnp.int32, count)
    eye = (index[:, None] == index).astype(points.dtype)
    infinity = jnp.asarray(jnp.inf, points.dtype)

    def heights(w: Array, mu: Array) -> tuple[Array, Array, Array]:
        r = residuals(points, w)
        norms = jnp.linalg.norm(r, axis=-1)
        return r, norms, jnp.sqrt(mu**2 + norms**2)

    def potential(w: Array, mu: Array) -> Array:
        _, _, root = heights(w, mu)
        return jnp.sum(root - mu * jnp.log(mu + root)) - mu * jnp.sum(jnp.log(w))

    def step(path: _Path) -> _Path:
        w, mu, best, kept, number, _ = path
        r, norms, root = heights(w, mu)
        height = mu + root
        dual = r / height[:, None]
        slopes = jnp.einsum("lkm,lm->lk", layers, r) * w  # in the logarithms of the weights
        gradient = jnp.sum(slopes / height[:, None], axis=0) - mu
        bound = jnp.min(jnp.einsum("lkm,lm->k", layers, dual))
        kept = jnp.where(bound > best, dual, kept)
        best = jnp.maximum(bound, best)
        objective = jnp.sum(norms)
        gap = objective - best
        hessian = jnp.tensordot(1.0 / height, grams, 1) * w[:, None] * w
        hessian = hessian - (slopes / (height**2 * root)[:, None]).T @ slopes + mu * eye
        # Changes keep the sum: a multiple of w w^T alters nothing but the conditioning.
        scaled = w / jnp.linalg.norm(w)
        hessian = hessian + jnp.sum(hessian * eye) / count * scaled[:, None] * scaled
        # In the units of each weight: what mu holds at zero must not feel the stiff terms.
        hessian = hessian + 1e-15 * hessian * eye
        factor = cholesky(hessian, symmetrize_input=False)
        half = triangular_solve(
            factor, jnp.stack([-gradient, w], axis=1), left_side=True, lower=True
        )
        both = triangular_solve(factor, half, left_side=True, lower=True, transpose_a=True)
        change = both[:, 0] - (w @ both[:, 0]) / (w @ both[:, 1]) * both[:, 1]
        descent = jnp.maximum(-(gradient @ change), 0.0)
        decrement = jnp.sqrt(descent / mu)
        here = potential(w, mu)
        least = 1.0 / (1.0 + decrement)
        falling = jnp.min(
            jnp.where(change < 0, -1.0 / jnp.where(change < 0, change, 1.0), infinity)
        )

        def too_far(length: Array) -> Array:
            reached = potential(w * (1.0 + length * change), mu)
            return (length > least) & ~(reached <= here - 0.25 * length * descent)

        first = jnp.minimum(1.0, 0.95 * falling)
        length = jax.lax.while_loop(too_far, lambda t: 0.5 * t, first)
        new = w * (1.0 + jnp.maximum(length, jnp.minimum(least, first)) * change)
        new = new / jnp.sum(new)
        usable = jnp.all(jnp.isfinite(new)) & jnp.all(new > 0)
        done = (gap <= tolerance * objective) | (objective <= floor) | (mu <= 1e-2 * floor)
        done = done | ~usable
        return _Path(
            jnp.where(done, w, new),
            jnp.where(done | (decrement > 0.5), mu, SHRINKS * mu),
            best,
            kept,
            number + (~done).astype(jnp.int32),
            done,
        )

    w = jnp.full(count, 1.0 / count, points.dtype)
    start = jnp.sum(jnp.linalg.norm(residuals(points, w), axis=-1))
    zero = jnp.zeros((), points.dtype)
    dual = jnp.zeros_like(points[0])
    first = _Path(
        w, 0.1 * start / (terms + count), zero, dual, jnp.asarray(0, jnp.int32), start <= floor
    )
    found = jax.lax.while_loop(lambda s: (s.step < steps) & ~s.done, step, first)
    return found.w, found.dual, found.step
