"""Minimise a sum of norms, or of squared norms, of convex combinations: one call, several methods.

    min_w  sum_l ||sum_k w_k p_kl - t_l||      or      sum_l ||sum_k w_k p_kl - t_l||^2
    with   w_k >= 0,  sum_k w_k = 1

The first is a second-order cone problem, the second a quadratic one: the point of a polytope
nearest to another. Every answer carries a certified lower bound of the minimum.
"""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
from jax.core import Tracer

from jaxface._types import Array, Float
from jaxface.solvers.finiteness import TOTAL, flags, holds_no_number
from jaxface.solvers.simplex._projected_gradient import projected_gradient
from jaxface.solvers.simplex._working_set import working_set
from jaxface.solvers.simplex.answer import ZERO, Answer, Norm, rounded
from jaxface.solvers.simplex.implicit import with_derivative
from jaxface.solvers.simplex.many import better, pays, solve_many
from jaxface.solvers.solution import Solution, stopped

Method = Literal["working_set", "interior_point", "projected_gradient"]

TOLERANCE = 1e-11
"""default relative gap; double precision inside reaches it at residuals down to about 1e-4 of the
points' distances"""


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
    problems are solved one after another, so that an easy one does not wait for a hard one;
    many targets over points that are not mapped over share what they can (`simplex_many`).

    Methods: ``working_set`` (column generation over an interior point method, and for up to 256
    points a slower one for what that leaves; the default),
    ``interior_point`` (over all points at once), ``projected_gradient`` (jaxopt; inexact).

    Args:
        points: of the hull.
        target: in the same space.
        norm: sum of the norms, or of their squares.
        method: see above.
        start: weights to start from, e.g. of a similar problem. Negative ones are dropped.
        tolerance: relative gap to stop at.

    Returns:
        ``value``: the weights. ``stats``: the other fields of `Answer`, by name, and
        ``not_finite``, see `Solution`. Where the gap stays above the tolerance the result is
        ``nonlinear_max_steps_reached``, and `reason` tells the gap: points that differ by 1e-7 of
        their distances or less cost digits of it.

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
    broken = holds_no_number((answer.weights, answer.objective))
    stats = answer._asdict() | {"objective": objective, "not_finite": {TOTAL: flags(broken)}}
    del stats["weights"], stats["converged"]
    return Solution(value, stopped(broken, answer.converged, False), stats)


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
    return rounded(points, scale, target, found, tolerance, norm=norm, dtype=dtype)


@lru_cache
def _sequential(norm: Norm, method: Method, dtype: str) -> Callable[..., Answer]:
    """`_run` that maps: many targets share their points' products, other problems take turns."""
    run = jax.custom_batching.custom_vmap(partial(_run, norm, method, dtype))

    @run.def_vmap
    def rule(size: int, mapped: Any, points: Any, target: Any, start: Any, tolerance: Any) -> Any:
        data, axes = (points, target, start, tolerance), tuple(mapped)
        with jax.enable_x64(True):
            if (
                axes[:2] == (False, True)
                and not axes[3]
                and method == "working_set"
                and pays(size, len(points))
            ):
                starts = start if axes[2] else jnp.broadcast_to(start, (size, *start.shape))
                answer = solve_many(norm, dtype, points, target, starts, tolerance)

                def left_over(data: tuple[Answer, Array]) -> Answer:
                    found, goal = data
                    return jax.lax.cond(
                        found.converged,
                        lambda: found,
                        lambda: better(found, run(points, goal, _double(found.weights), tolerance)),
                    )

                answer = jax.lax.map(left_over, (answer, target))
            else:

                def one(own: list[Array]) -> Answer:
                    rest = iter(own)
                    return run(*(next(rest) if m else x for x, m in zip(data, axes, strict=True)))

                turns = [x for x, m in zip(data, axes, strict=True) if m]
                answer = jax.lax.map(one, turns)
        return answer, jax.tree.map(lambda _: True, answer)

    return run


@partial(jax.jit, static_argnames="norm")
def _scaled(points: Array, target: Array, *, norm: Norm) -> tuple[Array, Array]:
    """Differences to the target of order one. Squares of several terms make one norm."""
    points = points - target
    if norm == "squared":
        points = points.reshape(len(points), 1, -1)
    lengths = jnp.sum(jnp.linalg.norm(points, axis=-1), axis=-1)
    scale = jnp.max(lengths)
    return points / jnp.where(scale > 0, scale, 1.0), scale


def _double(x: Any) -> Array:
    if isinstance(x, jax.Array):
        return jax.lax.convert_element_type(x, jnp.float64)
    return jnp.asarray(x, jnp.float64)


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
