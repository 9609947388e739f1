"""Equation 2 of Saito 2017 as a function with a gradient."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
from jax.core import Tracer

from jaxface._types import Array, Float
from jaxface.solvers.simplex._minimise_on_simplex import TOLERANCE, Method, Norm, solve
from jaxface.solvers.simplex.implicit import with_derivative
from jaxface.solvers.simplex.reduction import reduced
from jaxface.stages.blending.columns import (
    check_database,
    check_layer_weights,
    half_indices,
)


def blend_weights(
    database: Mapping[str, Float[Array, "k n n"]],
    target: Mapping[str, Float[Array, "n n"]],
    *,
    norm: Norm = "frobenius",
    method: Method = "working_set",
    weights: Mapping[str, Float[Array, ""]] | None = None,
    start: Float[Array, " k"] | None = None,
    tolerance: float = TOLERANCE,
) -> tuple[Float[Array, " k"], Float[Array, ""]]:
    """The blend's weights and its objective, for use inside ``jit``, ``vmap`` and derivatives.

    Differentiable in the database, the target and the layers' factors, in forward and reverse
    mode, by the implicit function theorem (see ``solvers.simplex_implicit`` for the points where
    there is no derivative). Everything is in memory, the columns in double precision. Under
    ``vmap`` over targets alone the database is reduced once.

    Args:
        database: as in `blend`.
        target: as in `blend`, one.
        norm: as in `blend`.
        method: as in `blend`.
        weights: factors by layer, positive.
        start: weights to start from; no derivative.
        tolerance: relative gap to stop at.

    Raises:
        ValueError: layers or shapes do not fit together. Entries are not looked at: NaN gives NaN.
    """
    layers, _ = check_database(database)
    if set(target) != set(layers):
        raise ValueError(f"the target has layers {sorted(target)}, the database {sorted(layers)}")
    traced = {k: v for k, v in (weights or {}).items() if isinstance(v, Tracer)}
    known = {k: v for k, v in (weights or {}).items() if k not in traced}
    check_layer_weights(known, layers)
    columns, goals = [], []
    for name in layers:
        if jnp.shape(target[name]) != jnp.shape(database[name])[1:]:
            raise ValueError(
                f"layer {name!r} of the target has shape {jnp.shape(target[name])}; the "
                f"database's matrices are {jnp.shape(database[name])[1:]}"
            )
        factor = jnp.asarray((weights or {}).get(name, 1.0))
        factor = jnp.sqrt(factor) if norm == "squared" else factor
        grams, goal = jnp.asarray(database[name]), jnp.asarray(target[name])
        rows, cols, root = half_indices(goal.shape[-1])
        scale = (factor * root).astype(grams.dtype)
        columns.append(grams[:, rows, cols] * scale)
        goals.append(goal[rows, cols] * scale)

    dtype = jnp.result_type(*columns, *goals).name
    with jax.enable_x64(True):
        short = [reduced(_exact(a), _exact(b)) for a, b in zip(columns, goals, strict=True)]
        if norm == "squared":
            joined = [jnp.concatenate(parts, axis=-1) for parts in zip(*short, strict=True)]
            short = [reduced(joined[0], joined[1])]
        size = max(b.shape[0] for _, b in short)
        points = jnp.stack([jnp.pad(a, ((0, 0), (0, size - a.shape[1]))) for a, _ in short], axis=1)
        goal = jnp.stack([jnp.pad(b, (0, size - b.shape[0])) for _, b in short])
    if start is not None:
        start = jax.lax.stop_gradient(start)
    answer = solve(points, goal, start, norm=norm, method=method, tolerance=tolerance, dtype=dtype)
    return with_derivative(
        norm == "squared", answer.weights, answer.objective, tuple(columns), tuple(goals)
    )


def _exact(x: Array) -> Array:
    return jax.lax.convert_element_type(jax.lax.stop_gradient(x), jnp.float64)
