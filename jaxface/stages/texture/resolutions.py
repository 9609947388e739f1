"""The resolutions of a synthesis: levels, their share of the steps, the box that is synthesised."""

import numpy as np

from jaxface._types import Bool

COARSEST = 256
"""texels along a side of the first level, at least"""


def resolutions(side: int, coarsest: int = COARSEST) -> list[int]:
    """Texels along a side of each level, coarsest first, each half of the next."""
    levels = [side]
    while levels[0] >= 2 * coarsest and levels[0] % 2 == 0:
        levels.insert(0, levels[0] // 2)
    return levels


def level_steps(iterations: int, levels: int) -> list[int]:
    """Steps at each level, coarsest first: half as many at each finer one, one at least."""
    shares = 0.5 ** np.arange(levels)
    return [max(1, round(iterations * share)) for share in shares / shares.sum()]


def free_box(
    free: Bool[np.ndarray, "r r"], levels: list[int]
) -> tuple[tuple[int, int], tuple[int, int]]:
    """First corner and end (row, column) of a box around the free texels.

    It lies on whole texels of every level, with a margin of 16 to 32 texels of the coarsest.
    """
    side = len(free)
    rows, columns = np.nonzero(free)
    grain = side // levels[0] * 16
    low = (np.array([rows.min(), columns.min()]) // grain - 1).clip(0) * grain
    high = ((np.array([rows.max(), columns.max()]) // grain + 2) * grain).clip(max=side)
    return (int(low[0]), int(low[1])), (int(high[0]), int(high[1]))
