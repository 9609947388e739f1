"""Minimise a sum of norms, or of squared norms, of convex combinations: one call, several methods.

    min_w  sum_l ||sum_k w_k p_kl - t_l||      or      sum_l ||sum_k w_k p_kl - t_l||^2
    with   w_k >= 0,  sum_k w_k = 1

The first is a second-order cone problem, the second a quadratic one: the point of a polytope
nearest to another. Every answer carries a certified lower bound of the minimum.
"""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import optimistix as optx
from jax.core import Tracer

from jaxface._types import Array, Float
from jaxface.solvers.simplex_certificate import residuals
from jaxface.solvers.simplex_implicit import with_derivative
from jaxface.solvers.simplex_projected_gradient import projected_gradient
from jaxface.solvers.simplex_working_set import Found, working_set
from jaxface.solvers.solution import Solution

Norm = Literal["frobenius", "squared"]
Method = Literal["working_set", "interior_point", "projected_gradient"]

TOLERANCE = 1e-11
"""default relative gap; double precision inside reaches it at residuals down to about 1e-4 of the
points' distances"""
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
        converged: within the tolerance before rounding to single precision.
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


def minimise_on_simplex(
    points: Float[Array, "k l m"],
    target: Float[Array, "l m"],
    *,
    norm: Norm = "frobenius",
    method: Method = "working_set",
    start: Float[Array, " k"] | None = None,
    tolerance: float = TOLERANCE,
) -> Solution:
    """Weights of the convex combination of points nearest to a target, in ``l`` terms.

    Works in double precision inside, whatever the precision of its data: the gap of a solve is a
    difference of close numbers, and rounding ``p - t`` to single precision alone would cost more
    than the promised 1e-6. Single-precision data are taken as exact; the certificate is of the
    weights as returned, over their sum. Relative gaps reach about 1e-11 from double and
    1e-8 from single-precision data (the weights' own rounding), less where the residual is below
    1e-3 of the points' distances.

    Differentiable with respect to points and target in ``value`` and ``stats["objective"]``, by
    the implicit function theorem (see ``simplex_implicit``). jit-able; under ``vmap`` the
    problems are solved one after another, so that an easy one does not wait for a hard one,
    and points that are not mapped over are not copied.

    Methods: ``working_set`` (column generation over an interior point method; the default),
    ``interior_point`` (over all points at once), ``projected_gradient`` (jaxopt; inexact).

    Args:
        points: of the hull.
        target: in the same space.
        norm: sum of the norms, or of their squares.
        method: see above.
        start: weights to start from, e.g. of a similar problem. Negative ones are dropped.
        tolerance: relative gap to stop at.

    Returns:
        ``value``: the weights. ``stats``: the other fields of `Answer`, by name.

    Raises:
        ValueError: shapes do not fit together, or an unknown norm or method.
    """
    _check(points, target, norm, method, start)
    dtype = jnp.result_type(points, target)
    if not jnp.issubdtype(dtype, jnp.floating):
        dtype = jnp.result_type(float)
    answer = solve(
        jax.lax.stop_gradient(points),
        jax.lax.stop_gradient(target),
        None if start is None else jax.lax.stop_gradient(start),
        norm=norm, method=method, tolerance=tolerance, dtype=jnp.dtype(dtype).name,
    )  # fmt: skip
    terms = range(points.shape[1])
    value, objective = with_derivative(
        norm == "squared",
        answer.weights,
        answer.objective,
        tuple(jnp.asarray(points[:, i], dtype) for i in terms),
        tuple(jnp.asarray(target[i], dtype) for i in terms),
    )
    stats = answer._asdict() | {"objective": objective}
    del stats["weights"], stats["converged"]
    return Solution(value, _result(answer.converged), stats)


def solve(
    points: Any,
    target: Any,
    start: Any = None,
    *,
    norm: Norm = "frobenius",
    method: Method = "working_set",
    tolerance: float = TOLERANCE,
    dtype: str = "float64",
) -> Answer:
    """`minimise_on_simplex` without the derivative; NumPy doubles stay double in single mode."""
    with jax.enable_x64(True):
        count = points.shape[0]
        if start is None:
            weights = jnp.full(count, 1.0 / count, jnp.float64)
        else:
            weights = jnp.maximum(_double(start), 0.0)
            weights = weights / jnp.sum(weights)
        data = (_double(points), _double(target), weights, jnp.asarray(tolerance, jnp.float64))
        traced = any(isinstance(x, Tracer) for x in data)
        run = _sequential(norm, method, dtype) if traced else partial(_run, norm, method, dtype)
        return run(*data)


def _run(
    norm: Norm,
    method: Method,
    dtype: str,
    points: Array,
    target: Array,
    weights: Array,
    tolerance: Array,
) -> Answer:
    points, scale = _scaled(points, target, norm=norm)
    floor = jnp.asarray(ZERO, jnp.float64)
    if method == "working_set":
        found = working_set(points, weights, tolerance, floor)
    elif method == "interior_point":
        found = working_set(points, weights, tolerance, floor, sets=())
    else:
        squared = norm == "squared"
        found = projected_gradient(points, weights, tolerance, floor, squared=squared)
    return _rounded(points, scale, target, found, tolerance, norm=norm, dtype=dtype)


@lru_cache
def _sequential(norm: Norm, method: Method, dtype: str) -> Callable[..., Answer]:
    return jax.custom_batching.sequential_vmap(partial(_run, norm, method, dtype))


@partial(jax.jit, static_argnames="norm")
def _scaled(points: Array, target: Array, *, norm: Norm) -> tuple[Array, Array]:
    """Differences to the target of order one. Squares of several terms make one norm."""
    points = points - target
    if norm == "squared":
        points = points.reshape(len(points), 1, -1)
    lengths = jnp.sum(jnp.linalg.norm(points, axis=-1), axis=-1)
    scale = jnp.max(lengths)
    return points / jnp.where(scale > 0, scale, 1.0), scale


@partial(jax.jit, static_argnames=("norm", "dtype"))
def _rounded(
    points: Array,
    scale: Array,
    target: Array,
    found: Found,
    tolerance: Array,
    *,
    norm: Norm,
    dtype: str,
) -> Answer:
    """The certificate of the weights as they are after rounding to ``dtype``."""
    single = dtype != "float64"
    weights = _sparse(points, found, tolerance)
    if single:
        weights = jax.lax.reduce_precision(weights, 8, 23)
    r = residuals(points, weights / jnp.sum(weights))
    objective = jnp.sum(jnp.linalg.norm(r, axis=-1)) * scale
    norms = jnp.linalg.norm(r.reshape(target.shape), axis=-1) * scale
    bound = found.certificate.bound * scale
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
        found.rounds, found.steps, found.converged,
    )  # fmt: skip
    narrow = {
        name: jax.lax.convert_element_type(value, dtype)
        for name, value in answer._asdict().items()
        if jnp.issubdtype(value.dtype, jnp.floating)
    }
    counts = {name: jnp.asarray(getattr(answer, name), jnp.int32) for name in ("rounds", "steps")}
    return answer._replace(**narrow, **counts)


def _sparse(points: Array, found: Found, tolerance: Array) -> Array:
    """The weights without what the objective does not miss: the fewest that serve."""
    best = found.weights
    for share in (1e-8, 1e-6, 1e-4):
        fewer = jnp.where(found.weights > share * jnp.max(found.weights), found.weights, 0.0)
        fewer = fewer / jnp.sum(fewer)
        objective = jnp.sum(jnp.linalg.norm(residuals(points, fewer), axis=-1))
        limit = found.certificate.objective * (1.0 + 0.1 * tolerance)
        best = jnp.where(objective <= limit, fewer, best)
    return best


def _double(x: Any) -> Array:
    if isinstance(x, jax.Array):
        return jax.lax.convert_element_type(x, jnp.float64)
    return jnp.asarray(x, jnp.float64)


def _result(converged: Array) -> Any:
    good, limit = optx.RESULTS.successful, optx.RESULTS.nonlinear_max_steps_reached
    return optx.RESULTS.where(converged, good, limit)


def _check(points: Any, target: Any, norm: str, method: str, start: Any) -> None:
    if norm not in get_args(Norm):
        raise ValueError(f"norm is {norm!r}; it must be one of {get_args(Norm)}")
    if method not in get_args(Method):
        raise ValueError(f"method is {method!r}; it must be one of {get_args(Method)}")
    if points.ndim != 3 or 0 in points.shape:
        raise ValueError(f"points has shape {points.shape}; it must be (k, l, m), none of them 0")
    if target.shape != points.shape[1:]:
        raise ValueError(f"target has shape {target.shape}; points need {points.shape[1:]}")
    if start is not None and start.shape != points.shape[:1]:
        raise ValueError(f"start has shape {start.shape}; there are {points.shape[0]} points")
