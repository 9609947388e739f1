"""What a solve on the simplex answers, and its certificate after rounding."""

from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp

from jaxface._types import Array, Float
from jaxface.solvers.simplex._working_set import Found
from jaxface.solvers.simplex.certificate import residuals

Norm = Literal["frobenius", "squared"]

ZERO = 1e-12
"""an objective below this share of the points' greatest distance counts as zero"""


class Answer(NamedTuple):
    """Numbers of a solve on the simplex, in the precision of its data.

    Attributes:
        weights: on the simplex; the certificate is of these, after rounding.
        objective: value at the weights.
        lower_bound: certified; the minimum is not below it.
        gap: ``objective - lower_bound``, from double precision.
        relative_gap: the gap as a share of the objective; 0 where that is zero.
        scale: the points' greatest distance from the target (squared for squared norms):
            the gap as a share of this is meaningful where the objective vanishes.
        norms: ``||r_l||`` of the terms, not squared.
        dual: the vectors ``y_l`` of the bound.
        rounds: exchanges of the working set.
        steps: steps of the method, in all.
        converged: within the tolerance, before or after rounding.
    """

    weights: Float[Array, " k"]
    objective: Float[Array, ""]
    lower_bound: Float[Array, ""]
    gap: Float[Array, ""]
    relative_gap: Float[Array, ""]
    scale: Float[Array, ""]
    norms: Float[Array, " l"]
    dual: Float[Array, "l m"]
    rounds: Array
    steps: Array
    converged: Array


@partial(jax.jit, static_argnames=("norm", "dtype"))
def rounded(
    points: Array,
    scale: Array,
    target: Array,
    found: Found,
    tolerance: Array,
    origin: Array | float = 0.0,
    *,
    norm: Norm,
    dtype: str,
) -> Answer:
    """The certificate of the weights as they are after rounding to ``dtype``.

    ``origin`` is where the target lies among ``points``.
    """
    single = dtype != "float64"
    weights = sparse(points, found, tolerance, origin)
    if single:
        weights = jax.lax.reduce_precision(weights, 8, 23)
    r = residuals(points, weights / jnp.sum(weights)) - origin
    objective = jnp.sum(jnp.linalg.norm(r, axis=-1)) * scale
    norms = jnp.linalg.norm(r.reshape(target.shape), axis=-1) * scale
    bound = found.certificate.bound * scale
    done = (objective - bound <= tolerance * objective) | (objective <= ZERO * scale)
    dual = found.certificate.dual.reshape(target.shape)
    if norm == "squared":
        gap = (objective - bound) * (objective + bound)
        objective, bound, scale = objective**2, bound**2, scale**2
    else:
        gap = objective - bound
    gap = jnp.maximum(gap, 0.0)
    relative = jnp.where(objective > 0, gap / jnp.where(objective > 0, objective, 1.0), 0.0)
    lower = bound.astype(dtype)
    if single:  # a bound must not be rounded up
        lower = jnp.where(lower.astype(bound.dtype) > bound, jnp.nextafter(lower, -jnp.inf), lower)
    answer = Answer(
        weights, objective, lower, gap, relative, scale, norms, dual,
        found.rounds, found.steps, found.converged | done,
    )  # fmt: skip
    narrow = {
        name: jax.lax.convert_element_type(value, dtype)
        for name, value in answer._asdict().items()
        if jnp.issubdtype(value.dtype, jnp.floating)
    }
    counts = {name: jnp.asarray(getattr(answer, name), jnp.int32) for name in ("rounds", "steps")}
    return answer._replace(**narrow, **counts)


def sparse(points: Array, found: Found, tolerance: Array, origin: Array | float) -> Array:
    """The weights without what the objective does not miss: the fewest that serve."""
    best = found.weights
    for share in (1e-8, 1e-6, 1e-4):
        fewer = jnp.where(found.weights > share * jnp.max(found.weights), found.weights, 0.0)
        fewer = fewer / jnp.sum(fewer)
        objective = jnp.sum(jnp.linalg.norm(residuals(points, fewer) - origin, axis=-1))
        limit = found.certificate.objective * (1.0 + 0.1 * tolerance)
        best = jnp.where(objective <= limit, fewer, best)
    return best
