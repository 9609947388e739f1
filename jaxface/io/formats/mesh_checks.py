"""What a mesh must be before it is written: shapes, finite numbers, indices in range."""

from typing import Any

import numpy as np


def check_table(name: str, values: Any, width: int, count: int | None = None) -> np.ndarray:
    """Values as float64 of shape ``(count or any, width)``.

    Raises:
        ValueError: another shape, or NaN or Inf; the message names the argument.
    """
    table = np.asarray(values, np.float64)
    rows = "n" if count is None else count
    if table.ndim != 2 or table.shape[1] != width or count not in (None, len(table)):
        raise ValueError(f"{name} of shape {table.shape}; needed ({rows}, {width})")
    if not np.isfinite(table).all():
        raise ValueError(f"{name} has NaN or Inf; needed finite numbers")
    return table


def check_indices(
    name: str,
    values: Any,
    limit: int,
    corners: tuple[int, ...],
    like: np.ndarray | None = None,
) -> np.ndarray:
    """Polygons as integers below ``limit``, with 3 corners or 4 of which the last may be -1.

    Args:
        name: of the argument.
        values: the polygons.
        limit: number of things the indices count.
        corners: the widths allowed.
        like: polygons whose shape these must share.

    Raises:
        ValueError: another shape or type, or an index out of range; names the argument.
    """
    table = np.asarray(values)
    if table.ndim != 2 or table.shape[1] not in corners or table.dtype.kind not in "iu":
        wanted = " or ".join(map(str, corners))
        raise ValueError(
            f"{name} of shape {table.shape} and type {table.dtype}; needed (f, {wanted}) integers"
        )
    if like is not None and table.shape != like.shape:
        raise ValueError(f"{name} of shape {table.shape}; needed {like.shape}")
    if table.size and (
        table[:, :3].min() < 0 or table[:, 3:].min(initial=0) < -1 or table.max() >= limit
    ):
        raise ValueError(
            f"{name} has indices {table.min()} to {table.max()}; needed 0 to {limit - 1}"
        )
    return table
