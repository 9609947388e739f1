"""Equation 2 of Saito 2017 on a database that may be memory-mapped.

The matrices are reduced to ``K + 1`` numbers a layer once (see ``solvers.reduction``), whatever the
size of the layers; the solver works on those.
"""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Float
from jaxface.solvers.simplex._minimise_on_simplex import TOLERANCE, Method, solve
from jaxface.solvers.simplex.answer import Answer, Norm
from jaxface.solvers.simplex.many import better, pays, solve_many
from jaxface.solvers.simplex.reduction import triangular_factor
from jaxface.stages.blending.columns import (
    blocks,
    check_database,
    check_layer_weights,
    check_target,
    find_not_finite,
    precision,
)
from jaxface.stages.blending.mixing import layer_residuals


class Blend(NamedTuple):
    """Weights of a database's subjects, and how good they are. NumPy arrays.

    For several targets every array has a leading axis.
    """

    weights: Float[np.ndarray, " k"]
    """on the simplex; those of ``unconstrained`` are not"""
    objective: Float[np.ndarray, ""]
    """of equation 2, or of its squared form, at the weights"""
    lower_bound: Float[np.ndarray, ""]
    """certified: no point of the simplex does better; 0 (which holds too) from the baselines"""
    gap: Float[np.ndarray, ""]
    """``objective - lower_bound``, before they were rounded"""
    relative_gap: Float[np.ndarray, ""]
    """the gap as a share of the objective; 0 where that is zero"""
    residuals: dict[str, Float[np.ndarray, ""]]
    """Frobenius norm of the difference by layer, from the matrices themselves; neither squared
    nor weighted"""
    stats: dict[str, Any]
    """``rounds`` and ``steps`` of the solver; ``converged``; ``scale``, the greatest objective of a
    single subject, which to compare the gap with where the objective vanishes"""


class Reduced(NamedTuple):
    """A database and targets in few dimensions, all distances as they were. NumPy doubles.

    For squared norms all layers make one term.
    """

    points: Float[np.ndarray, "k l m"]
    targets: Float[np.ndarray, "t l m"]


def blend(
    database: Mapping[str, Float[Array, "k n n"]],
    target: Mapping[str, Float[Array, "*t n n"]],
    *,
    norm: Norm = "frobenius",
    method: Method = "working_set",
    weights: Mapping[str, float] | None = None,
    start: Float[Array, "*t k"] | None = None,
    tolerance: float = TOLERANCE,
) -> Blend:
    """Solve equation 2: ``min sum_l c_l ||sum_k w_k G_kl - G_l||_F`` over the simplex.

    A memory-mapped database is read about once, in blocks. The answer has the
    precision of its input; relative gaps reach about 1e-11 from double and 1e-8 from single
    precision, and the answer says what it reached. For a gradient see `blend_weights`.

    Args:
        database: masked Gram matrices of K subjects by layer; symmetric (the upper half is read).
        target: those of the photo by layer; with a leading axis for several at once, which share
            the work of the reduction.
        norm: sum of the norms (the paper's), or of their squares (a quadratic programme).
        method: see ``solvers.simplex.minimise_on_simplex``.
        weights: factors ``c_l`` by layer, default 1.
        start: weights to start from. Without them, each further target starts at the answer before.
        tolerance: relative gap to stop at.

    Raises:
        ValueError: layers or shapes do not fit together, an entry is not finite, there is but one
            subject, or all subjects are equal (no weights are better than others).
    """
    problem = reduce_database(database, target, norm=norm, weights=weights)
    answer = blend_reduced(
        problem, norm=norm, method=method, start=start, tolerance=tolerance,
        dtype=precision(database, target),
    )  # fmt: skip
    residuals = layer_residuals(database, target, answer.weights)
    fields = {name: getattr(answer, name) for name in answer._fields}
    if all(np.ndim(x) == 2 for x in target.values()):
        fields = {name: value[0] for name, value in fields.items()}
        residuals = {name: value[0] for name, value in residuals.items()}
    return Blend(
        fields["weights"],
        fields["objective"],
        fields["lower_bound"],
        fields["gap"],
        fields["relative_gap"],
        residuals,
        {name: fields[name] for name in ("rounds", "steps", "converged", "scale")},
    )


def reduce_database(
    database: Mapping[str, Float[Array, "k n n"]],
    target: Mapping[str, Float[Array, "*t n n"]],
    *,
    norm: Norm = "frobenius",
    weights: Mapping[str, float] | None = None,
) -> Reduced:
    """Equation 2 for T targets in at most ``K + T`` dimensions a layer. Arguments as in `blend`.

    The layers' factors are part of the result.

    Raises:
        ValueError: as `blend`.
    """
    layers, count = check_database(database)
    targets = check_target(database, target)
    check_layer_weights(weights, layers)
    if norm not in ("frobenius", "squared"):
        raise ValueError(f"norm is {norm!r}; it must be 'frobenius' or 'squared'")
    given = {name: float((weights or {}).get(name, 1.0)) for name in layers}
    factor = given if norm == "frobenius" else {name: c**0.5 for name, c in given.items()}
    columns = count + len(targets[layers[0]])
    short = []
    for group in [layers] if norm == "squared" else [(name,) for name in layers]:

        def read(sample: int | None, group: tuple[str, ...] = group) -> Iterator[np.ndarray]:
            for name in group:
                yield from blocks((database[name], targets[name]), factor[name], sample)

        try:
            short.append(triangular_factor(read, columns))
        except ValueError:
            find_not_finite(database, targets)
            raise
    stacked = np.stack([matrix.T for matrix in short], axis=1)
    points = stacked[:count]
    spread = np.linalg.norm(points - points[0], axis=(1, 2)).max()
    if spread <= 1e-12 * np.linalg.norm(points[0]):
        raise ValueError(
            f"all {count} subjects of the database have the same Gram matrices; "
            "no blend of them is better than another"
        )
    return Reduced(points, stacked[count:])


def blend_reduced(
    problem: Reduced,
    *,
    norm: Norm = "frobenius",
    method: Method = "working_set",
    start: Float[Array, "*t k"] | None = None,
    tolerance: float = TOLERANCE,
    dtype: str = "float64",
) -> Answer:
    """Solve a reduced problem for each of its targets; all fields get a leading axis.

    ``norm`` must be that of the reduction. Other arguments as in `blend`.
    """
    count = len(problem.targets)
    if method == "working_set" and pays(count, len(problem.points)):
        return _together(problem, start, norm, tolerance, dtype)
    starts: list[Any] = [None] * count
    if start is not None:
        starts = list(np.broadcast_to(np.asarray(start), (count, len(problem.points))))
    answers: list[Answer] = []
    for target, first in zip(problem.targets, starts, strict=True):
        if first is None and answers:
            first = answers[-1].weights
        answer = solve(
            problem.points, target, first,
            norm=norm, method=method, tolerance=tolerance, dtype=dtype,
        )  # fmt: skip
        answers.append(jax.tree.map(np.asarray, answer))
    return jax.tree.map(lambda *values: np.stack(values), *answers)


def _together(problem: Reduced, start: Any, norm: Norm, tolerance: float, dtype: str) -> Answer:
    """All targets at once; those that are not solved so, one by one."""
    shape = count, size = len(problem.targets), len(problem.points)
    starts = np.full(shape, 1.0 / size) if start is None else np.broadcast_to(start, shape)
    with jax.enable_x64(True):
        data = (jnp.asarray(x, jnp.float64) for x in (*problem, starts, tolerance))
        answer = solve_many(norm, dtype, *data)
    answer = jax.tree.map(np.array, answer)
    for number in np.flatnonzero(~answer.converged):
        found = jax.tree.map(lambda x, i=number: x[i], answer)
        alone = solve(
            problem.points, problem.targets[number], found.weights,
            norm=norm, tolerance=tolerance, dtype=dtype,
        )  # fmt: skip
        for whole, value in zip(answer, better(found, alone), strict=True):
            whole[number] = value
    return answer
