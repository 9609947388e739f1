"""What the paper compares convex blending with: the nearest subject, and unconstrained blending."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxface._types import Array, Float
from jaxface.solvers.simplex._minimise_on_simplex import Norm
from jaxface.stages.blending.columns import (
    blocks,
    check_database,
    check_layer_weights,
    check_target,
)
from jaxface.stages.blending.mixing import mixed_difference
from jaxface.stages.blending.solve import Blend, reduce_database


def nearest_subject(
    database: Mapping[str, Float[Array, "k n n"]],
    target: Mapping[str, Float[Array, "n n"]],
    *,
    norm: Norm = "frobenius",
    weights: Mapping[str, float] | None = None,
) -> Blend:
    """All weight on the one subject with the least objective. Arguments as in `blend`.

    ``stats["objectives"]`` has every subject's.
    """
    layers, count = check_database(database)
    check_layer_weights(weights, layers)
    targets = _single(database, target)
    power = 1 if norm == "frobenius" else 2
    objectives = np.zeros(count)
    for name in layers:
        squares = np.zeros(count)
        for block in blocks((database[name], targets[name]), 1.0):
            squares += np.sum((block[:-1] - block[-1]) ** 2, axis=1)
        objectives += (weights or {}).get(name, 1.0) * squares ** (0.5 * power)
    best = int(np.argmin(objectives))
    one = np.zeros(count)
    one[best] = 1.0
    return _evaluated(database, targets, one, norm, weights, {"objectives": objectives})


def unconstrained(
    database: Mapping[str, Float[Array, "k n n"]],
    target: Mapping[str, Float[Array, "n n"]],
    *,
    norm: Norm = "frobenius",
    weights: Mapping[str, float] | None = None,
    rcond: float = 1e-10,
) -> Blend:
    """Least squares without constraints: the shortest weights with the least squared error.

    ``norm`` is that of the reported objective only. Singular values below ``rcond`` of the
    largest count as zero. Other arguments as in `blend`.
    """
    layers, _ = check_database(database)
    check_layer_weights(weights, layers)
    targets = _single(database, target)
    problem = reduce_database(database, target, norm="squared", weights=weights)
    w, _, rank, _ = np.linalg.lstsq(problem.points[:, 0].T, problem.targets[0, 0], rcond)
    return _evaluated(database, targets, w, norm, weights, {"rank": int(rank)})


def _single(database: Mapping[str, Any], target: Mapping[str, Any]) -> dict[str, np.ndarray]:
    targets = check_target(database, target)
    if any(len(stack) != 1 for stack in targets.values()):
        raise ValueError("the baselines take one target at a time")
    return targets


def _evaluated(
    database: Mapping[str, Any],
    targets: Mapping[str, np.ndarray],
    w: np.ndarray,
    norm: Norm,
    weights: Mapping[str, float] | None,
    stats: dict[str, Any],
) -> Blend:
    power = 1 if norm == "frobenius" else 2
    residuals = {}
    for name, grams in database.items():
        # sum w_k G_k - G, where the weights need not sum to one
        rest = mixed_difference(grams, w, targets[name][0])
        rest = rest + (w.sum() - 1.0) * targets[name][0]
        residuals[name] = np.asarray(np.linalg.norm(rest))
    objective = sum((weights or {}).get(name, 1.0) * r**power for name, r in residuals.items())
    return Blend(
        w,
        np.asarray(objective),
        np.zeros(()),
        np.asarray(objective),
        np.asarray(1.0 if objective > 0 else 0.0),
        residuals,
        stats,
    )
