"""Weighted sums of a database's Gram matrices, a few subjects at a time."""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxface._types import Array, Float

BLOCK_BYTES = 64 << 20
"""memory of the matrices that are summed at once, in double precision"""


def blended_grams(
    database: Mapping[str, Float[Array, "k n n"]], weights: Float[Array, " k"]
) -> dict[str, Any]:
    """``G_l = sum_k w_k G_kl``: with the weights of a blend, those of the complete texture.

    A memory-mapped database is read where a weight is not zero, 64 MB at a time, and summed in
    double precision; the result has the database's precision. Under a JAX transformation
    (traced weights or matrices) the sum is JAX's, and differentiable.

    Raises:
        ValueError: the number of weights is not that of the subjects.
    """
    for name, grams in database.items():
        if np.shape(weights) != np.shape(grams)[:1]:
            raise ValueError(
                f"weights has shape {np.shape(weights)}; layer {name!r} of the database has "
                f"{np.shape(grams)[0]} subjects"
            )
    traced = [x for x in (weights, *database.values()) if isinstance(x, Tracer)]
    if traced:
        return {name: jnp.tensordot(weights, grams, 1) for name, grams in database.items()}
    return {name: mixed(grams, np.asarray(weights)) for name, grams in database.items()}


def mixed(grams: Any, weights: Float[np.ndarray, " k"]) -> Float[np.ndarray, "n n"]:
    """One layer of `blended_grams`."""
    used = np.flatnonzero(weights)
    size = max(1, BLOCK_BYTES // (8 * grams.shape[1] * grams.shape[2]))
    total = np.zeros(grams.shape[1:])
    for first in range(0, len(used), size):
        part = used[first : first + size]
        block = np.stack([np.asarray(grams[k]) for k in part])
        total += np.tensordot(weights[part].astype(float), block.astype(float), 1)
    return total.astype(grams.dtype if grams.dtype in (np.float32, np.float64) else np.float32)


def layer_residuals(
    database: Mapping[str, Any], target: Mapping[str, Any], weights: Any
) -> dict[str, Float[np.ndarray, " t"]]:
    """Frobenius norms of the differences between blends and targets, by layer.

    Of the weights over their sum, so that their rounding does not count as an error.
    """
    found = {}
    for name, grams in database.items():
        goals = np.asarray(target[name]).reshape(-1, *grams.shape[1:])
        norms = []
        for w, goal in zip(np.asarray(weights, float), goals, strict=True):
            total = mixed_difference(grams, w / w.sum(), goal)
            norms.append(np.linalg.norm(total))
        found[name] = np.asarray(norms, np.float64)
    return found


def mixed_difference(
    grams: Any, weights: Float[np.ndarray, " k"], goal: Float[np.ndarray, "n n"]
) -> Float[np.ndarray, "n n"]:
    """``sum_k w_k (G_k - G)`` in double precision, subject by subject."""
    total = np.zeros(goal.shape)
    for k in np.flatnonzero(weights):
        total += weights[k] * (np.asarray(grams[k], float) - goal)
    return total
