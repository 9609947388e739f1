"""Value and certified lower bound of a sum of norms over the simplex.

The problem is ``min_w f(w) = sum_l ||sum_k w_k p_kl||`` over ``w >= 0, sum w = 1``. For any
vectors ``y_l`` with ``||y_l|| <= 1`` and any ``w`` of the simplex,
``f(w) >= sum_l y_l . sum_k w_k p_kl >= min_k sum_l y_l . p_kl``: the right side is a lower bound of
the minimum, tight for ``y_l = r_l / ||r_l||`` at the solution (Boyd and Vandenberghe, *Convex
Optimization*, 2004, section 5.2).
"""

from typing import NamedTuple

import jax.numpy as jnp

from jaxface._numerics import safe_normalize
from jaxface._types import Array, Float


class Certificate(NamedTuple):
    """How good a point of the simplex is.

    Attributes:
        objective: ``f(w)``, not below the minimum.
        bound: a lower bound of the minimum, from ``dual``.
        norms: ``||r_l||``, the terms of the objective.
        prices: ``sum_l y_l . p_kl`` for ``dual``; the smallest is the bound.
        dual: ``y_l``, each of length at most 1.
    """

    objective: Float[Array, ""]
    bound: Float[Array, ""]
    norms: Float[Array, " l"]
    prices: Float[Array, " k"]
    dual: Float[Array, "l m"]


def residuals(points: Float[Array, "k l m"], weights: Float[Array, " k"]) -> Float[Array, "l m"]:
    """``r_l = sum_k w_k p_kl``."""
    count, terms, size = points.shape
    return (weights @ points.reshape(count, terms * size)).reshape(terms, size)


def certify(
    points: Float[Array, "k l m"], weights: Float[Array, " k"], dual: Float[Array, "l m"]
) -> Certificate:
    """Value at ``weights``, and the better of the bounds of ``dual`` and of the unit residuals.

    The norms are not negative, so zero is a bound too; it is the one that holds where the target
    is in the hull.

    Args:
        points: of the problem.
        weights: a point of the simplex.
        dual: a candidate of any length; it is shortened to the unit ball.
    """
    count = len(points)
    r = residuals(points, weights)
    norms = jnp.linalg.norm(r, axis=-1)
    dual = dual / jnp.maximum(1.0, jnp.linalg.norm(dual, axis=-1, keepdims=True))
    candidates = jnp.stack([safe_normalize(r), dual])
    prices = points.reshape(count, -1) @ candidates.reshape(2, -1).T
    bounds = jnp.min(prices, axis=0)
    first = bounds[0] >= bounds[1]
    return Certificate(
        jnp.sum(norms),
        jnp.maximum(jnp.maximum(bounds[0], bounds[1]), 0.0),
        norms,
        jnp.where(first, prices[:, 0], prices[:, 1]),
        jnp.where(first, candidates[0], candidates[1]),
    )
