"""Gram matrices as columns, read in blocks; and the checks of a database and its targets.

A Gram matrix is symmetric: its upper half, with the off-diagonal entries times sqrt(2), is a
vector whose length is the matrix's Frobenius norm.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from jaxface._types import Float

BLOCK_BYTES = 8 << 20
"""memory of one block of columns in double precision: small enough to be read again from cache"""


def half_indices(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, columns and factors of the upper half of an (n, n) matrix, as ``n (n + 1) / 2``."""
    rows, columns = np.triu_indices(n)
    return rows, columns, np.where(rows == columns, 1.0, np.sqrt(2.0))


def blocks(
    matrices: tuple[Any, ...], scale: float, sample: int | None = None
) -> Iterator[Float[np.ndarray, "c rows"]]:
    """The matrices' upper halves side by side as columns, a block of rows at a time, as doubles.

    Args:
        matrices: stacks (k, n, n), e.g. a database and its targets; may be memory-mapped.
        scale: factor on everything.
        sample: only about so many rows, evenly spread and scaled to stand for all of them.
    """
    n = matrices[0].shape[-1]
    count = sum(len(stack) for stack in matrices)
    stride = 1 if sample is None else max(1, n * (n + 1) // 2 // sample)
    wanted = max(1, BLOCK_BYTES // (8 * count))
    off_diagonal = (2.0 * stride) ** 0.5 * scale
    lines = list(range(0, n, stride))
    while lines:
        taken, entries = [lines.pop(0)], 0
        entries = n - taken[0]
        while lines and entries + n - lines[0] <= wanted:
            entries += n - lines[0]
            taken.append(lines.pop(0))
        block = np.empty((count, entries))
        first = 0
        for stack in matrices:
            last, at = first + len(stack), 0
            for line in taken:
                block[first:last, at : at + n - line] = stack[:, line, line:]
                at += n - line
            first = last
        block *= off_diagonal
        block[:, np.cumsum([0, *(n - line for line in taken[:-1])])] *= 0.5**0.5
        yield block


def check_database(database: Mapping[str, Any]) -> tuple[tuple[str, ...], int]:
    """Names of the layers and number of subjects.

    Raises:
        ValueError: no layers, a wrong shape, or fewer than two subjects.
    """
    if not database:
        raise ValueError("the database has no layers; it needs at least one")
    counts = {}
    for name, grams in database.items():
        shape = np.shape(grams)
        if len(shape) != 3 or shape[1] != shape[2] or 0 in shape:
            raise ValueError(
                f"layer {name!r} of the database has shape {shape}; it must be (subjects, n, n)"
            )
        counts[name] = shape[0]
    if len(set(counts.values())) > 1:
        raise ValueError(
            f"the layers hold different numbers of subjects, {counts}; they must agree"
        )
    count = next(iter(counts.values()))
    if count < 2:
        raise ValueError("the database has 1 subject; blending needs at least two")
    return tuple(database), count


def check_target(
    database: Mapping[str, Any], target: Mapping[str, Any]
) -> dict[str, Float[np.ndarray, "t n n"]]:
    """The targets as stacks, one or several.

    Raises:
        ValueError: other layers than the database's, or shapes that do not fit.
    """
    _same_layers("target", target, database)
    stacks = {}
    for name, grams in database.items():
        value = np.asarray(target[name])
        if value.ndim not in (2, 3) or value.shape[-2:] != np.shape(grams)[1:]:
            raise ValueError(
                f"layer {name!r} of the target has shape {value.shape}; the database's matrices "
                f"are {np.shape(grams)[1:]}"
            )
        stacks[name] = value if value.ndim == 3 else value[None]
    counts = {name: len(stack) for name, stack in stacks.items()}
    if len(set(counts.values())) > 1 or 0 in counts.values():
        raise ValueError(f"the layers hold different numbers of targets, {counts}")
    return stacks


def check_layer_weights(weights: Mapping[str, Any] | None, layers: tuple[str, ...]) -> None:
    """Raises ValueError unless the layers' factors are positive and of layers there are."""
    for name, value in (weights or {}).items():
        if name not in layers:
            raise ValueError(f"weights has a layer {name!r}; the database has {layers}")
        if not (np.ndim(value) == 0 and np.isfinite(value) and value > 0):
            raise ValueError(f"the weight of layer {name!r} is {value!r}; it must be positive")


def find_not_finite(database: Mapping[str, Any], targets: Mapping[str, np.ndarray]) -> None:
    """Raises ValueError that names the first matrix with a NaN or infinite entry, if any."""
    for name in database:
        for kind, stack in (("subject", database[name]), ("target", targets[name])):
            for number in range(len(stack)):
                if not np.all(np.isfinite(stack[number])):
                    raise ValueError(
                        f"layer {name!r} of {kind} {number} holds NaN or infinite entries"
                    )


def precision(database: Mapping[str, Any], target: Mapping[str, Any]) -> str:
    """``float64`` where any of it is, else ``float32``."""
    found = {np.dtype(x.dtype) for part in (database, target) for x in part.values()}
    return "float64" if np.dtype("float64") in found else "float32"


def _same_layers(what: str, given: Mapping[str, Any], database: Mapping[str, Any]) -> None:
    missing, unknown = set(database) - set(given), set(given) - set(database)
    if missing or unknown:
        raise ValueError(
            f"the {what} has layers {sorted(given)}, the database {sorted(database)}; "
            "they must be the same"
        )
