"""Column generation over the simplex: solve on few points, price all of them, exchange.

Few points carry weight at the solution. A small problem is solved exactly on a working set;
the prices of all the points either certify the answer or say which points to bring in (von
Hohenbalken, "Simplicial decomposition in nonlinear programming algorithms", 1977). Where the
support outgrows the set, a larger one takes over, at last all points; what is still open of a small
problem then, the central path closes.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.core import Tracer

from jaxface._types import Array, Bool, Float, Int
from jaxface.solvers.simplex._barrier import central_path
from jaxface.solvers.simplex._interior_point import interior_point
from jaxface.solvers.simplex._polish import polish
from jaxface.solvers.simplex.certificate import Certificate, certify

SETS = (64, 256)
"""sizes of the working set that are tried in turn, before all points"""
SLOW = 256
"""most points over which the central path is followed"""
DUST = 1e-10
"""weights below this share of the largest are rounded to zero"""


class Found(NamedTuple):
    """What a solve on the simplex ends with.

    Attributes:
        weights: the best point found.
        certificate: of the weights, with the best bound found.
        rounds: exchanges of the working set.
        steps: interior-point steps in all.
        converged: the gap is within the tolerance, or the objective is zero to rounding.
    """

    weights: Float[Array, " k"]
    certificate: Certificate
    rounds: Int[Array, ""]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


def cleaned(weights: Float[Array, " k"]) -> Float[Array, " k"]:
    """Weights without dust, summing to one."""
    weights = jnp.where(weights > DUST * jnp.max(weights), weights, 0.0)
    return weights / jnp.sum(weights)


def improved(old: Found, weights: Array, dual: Array, points: Array) -> tuple[Found, Certificate]:
    """Keep the better of two points and the better of two bounds; also the new certificate."""
    new = certify(points, weights, dual)
    better = new.objective <= old.certificate.objective
    higher = new.bound >= old.certificate.bound
    objective = jnp.where(better, new.objective, old.certificate.objective)
    norms = jnp.where(better, new.norms, old.certificate.norms)
    bound, prices, dual = jax.tree.map(
        lambda a, b: jnp.where(higher, a, b),
        (new.bound, new.prices, new.dual),
        (old.certificate.bound, old.certificate.prices, old.certificate.dual),
    )
    best = Certificate(objective, bound, norms, prices, dual)
    return old._replace(weights=jnp.where(better, weights, old.weights), certificate=best), new


def closed(certificate: Certificate, tolerance: Array, floor: Array) -> Bool[Array, ""]:
    """The gap is within the tolerance, or the objective is zero to rounding."""
    gap = certificate.objective - certificate.bound
    return (gap <= tolerance * certificate.objective) | (certificate.objective <= floor)


@jax.jit
def started(points: Array, weights: Array, tolerance: Array, floor: Array) -> Found:
    """The state of a solve at its start."""
    first = certify(points, weights, jnp.zeros_like(points[0]))
    zero = jnp.asarray(0, jnp.int32)
    return Found(weights, first, zero, zero, closed(first, tolerance, floor))


@jax.jit
def all_points(points: Array, start: Found, tolerance: Array, floor: Array) -> Found:
    """One interior-point solve over every point."""
    weights, dual, steps = interior_point(
        points, jnp.ones(len(points), bool), 0.03 * tolerance, floor
    )
    found, _ = improved(start, cleaned(weights), dual, points)
    return found._replace(
        rounds=found.rounds + 1,
        steps=found.steps + steps,
        converged=closed(found.certificate, tolerance, floor),
    )


@jax.jit
def along_the_path(points: Array, start: Found, tolerance: Array, floor: Array) -> Found:
    """The slow and sure method over every point, kept as far as it helps."""
    weights, dual, steps = central_path(points, 0.03 * tolerance, floor)
    found, _ = improved(start, cleaned(weights), dual, points)
    return found._replace(
        rounds=found.rounds + 1,
        steps=found.steps + steps,
        converged=closed(found.certificate, tolerance, floor),
    )


def working_set(
    points: Float[Array, "k l m"],
    weights: Float[Array, " k"],
    tolerance: Float[Array, ""],
    floor: Float[Array, ""],
    *,
    sets: tuple[int, ...] = SETS,
    rounds: int = 15,
) -> Found:
    """Minimise ``sum_l ||sum_k w_k p_kl||`` over the simplex by column generation.

    Args:
        points: of order one.
        weights: start, on the simplex. One near the solution saves rounds.
        tolerance: stop at this gap, relative to the objective.
        floor: stop at this objective, which counts as zero.
        sets: sizes of the working set; those above a quarter of the number of points are left out.
        rounds: exchanges before the next size is tried.
    """
    found = started(points, weights, tolerance, floor)
    for size in [*(size for size in sets if 4 * size <= len(points)), None]:

        def attempt(found: Found, size: int | None = size) -> Found:
            if size is None:
                return all_points(points, found, tolerance, floor)
            return exchange(points, found, tolerance, floor, size=size, rounds=rounds)

        found = unless_converged(attempt, found)
        found = unless_converged(lambda f: polished(points, f, tolerance, floor), found)
    if len(points) > SLOW:
        return found
    found = unless_converged(lambda f: along_the_path(points, f, tolerance, floor), found)
    return unless_converged(lambda f: polished(points, f, tolerance, floor), found)


def unless_converged(function: Callable[[Found], Found], found: Found) -> Found:
    """``function(found)`` if there is need; where that is known, nothing else is compiled."""
    if isinstance(found.converged, Tracer):
        return jax.lax.cond(found.converged, lambda f: f, function, found)
    return found if found.converged else function(found)


@jax.jit
def polished(points: Array, found: Found, tolerance: Array, floor: Array) -> Found:
    """Newton steps on the face that was found, kept as far as they help."""
    weights, dual = polish(points, found.weights, found.certificate.dual)
    found, _ = improved(found, cleaned(weights), dual, points)
    return found._replace(converged=closed(found.certificate, tolerance, floor))


@partial(jax.jit, static_argnames=("size", "rounds"))
def exchange(
    points: Array, start: Found, tolerance: Array, floor: Array, *, size: int, rounds: int
) -> Found:
    """Rounds of one size of the working set, from the state ``start``."""

    def round_(carry: tuple[Found, Array, Array, Array]) -> tuple[Found, Array, Array, Array]:
        found, current, prices, number = carry
        held = jnp.where(current > 0, current, -1.0)
        least = jax.lax.top_k(held, size // 2)[0][-1]
        kept = (current > 0) & (current >= least)
        chosen = jax.lax.top_k(jnp.where(kept, jnp.inf, -prices), size)[1]
        gap = found.certificate.objective - found.certificate.bound
        aim = 1e-2 * gap / jnp.maximum(found.certificate.objective, floor)
        weights, dual, steps = interior_point(
            points[chosen],
            jnp.ones(size, bool),
            jnp.clip(aim, 0.03 * tolerance, 1e-4),
            floor,
        )
        current = cleaned(jnp.zeros_like(current).at[chosen].set(weights))
        found, new = improved(found, current, dual, points)
        found = found._replace(
            rounds=found.rounds + 1,
            steps=found.steps + steps,
            converged=closed(found.certificate, tolerance, floor),
        )
        return found, current, new.prices, number + 1

    carry = (start, start.weights, start.certificate.prices, jnp.asarray(0, jnp.int32))
    return jax.lax.while_loop(lambda c: ~c[0].converged & (c[3] < rounds), round_, carry)[0]
