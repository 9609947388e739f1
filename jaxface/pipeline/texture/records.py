"""What completing an albedo takes and gives: levels, results."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from jaxface._types import Float
from jaxface.stages.blending import Blend

Progress = Callable[[str, int, int, Callable[[], Float[np.ndarray, "h w 3"]] | None], None]
"""``(what, done, of, picture)``: a picture of the work so far where there is one"""

Blending = Callable[..., Blend]
"""``(database, target, norm=...)``, as `stages.blend.blend`"""


@dataclass(frozen=True)
class Completed:
    """A complete albedo and how it came about."""

    albedo: Float[np.ndarray, "r r 3"]
    """sRGB-encoded"""
    start: Float[np.ndarray, "r r 3"]
    """the texture before synthesis, sRGB-encoded"""
    blended: Blend
    names: tuple[str, ...]
    """subjects, in the order of the blend's weights"""
    analysed_at: int
    """texels along a side when photo and database were compared"""
    compared_by: str
    """where the database's statistics are from: ``network``, or the ``cache`` of `precompute`"""
    targets: dict[str, Float[np.ndarray, "n n"]]
    """Gram matrices that the finest level was to match"""
    box: tuple[slice, slice]
    """rows and columns of the synthesised part"""
    levels: list[dict[str, Any]]
    """a record for each level: name, values, terms, evaluations"""


class Level(NamedTuple):
    """One level of a synthesis, finished.

    Attributes:
        image: intensities in the box.
        targets: Gram matrices that it was to match.
        record: name, values, terms, evaluations.
    """

    image: Float[np.ndarray, "h w"]
    targets: dict[str, Float[np.ndarray, "n n"]]
    record: dict[str, Any]
