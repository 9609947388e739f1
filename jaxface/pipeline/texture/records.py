"""What completing an albedo takes and gives: settings, levels, results."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from jaxface._types import Float
from jaxface.energies._gram import DETAIL_WEIGHT, STYLE_LAYERS
from jaxface.stages.blending import Blend
from jaxface.stages.texture._synthesise import SynthesisWeights

Progress = Callable[[str, int, int, Callable[[], Float[np.ndarray, "h w 3"]] | None], None]
"""``(what, done, of, picture)``: a picture of the work so far where there is one"""

Blending = Callable[..., Blend]
"""``(database, target, norm=...)``, as `stages.blend.blend`"""


@dataclass(frozen=True)
class CompletionSettings:
    """How a texture is completed; the defaults are those of the command line."""

    alpha: float = DETAIL_WEIGHT
    """of eq. 3"""
    norm: str = "frobenius"
    """of eq. 2: ``frobenius`` (the paper's sum of unsquared norms) or ``squared``"""
    iterations: int = 1000
    """L-BFGS steps in all, most of them at the coarse levels"""
    layers: tuple[str, ...] = STYLE_LAYERS
    """L_G of eq. 3, and the layers that are compared in eq. 2"""
    weights: SynthesisWeights = field(default_factory=SynthesisWeights)
    match_complexion: bool = True
    """compare and blend the subjects' detail on the photo's complexion; False: as in the paper,
    where tone counts too"""
    match_octaves: bool = True
    """whether subjects whose complexion is matched get each octave of detail as strong as the
    photo's"""
    carry: float | None = 1.0
    """how far the hidden skin departs from the blend as the seen does; 0: the blend's as it is;
    None: as in the paper, where the seen skin's statistics are the blend's, too"""
    start: str = "neighbour"
    """first intensities: ``neighbour`` (detail of the subject of the largest weight) or
    ``low_frequency`` (the paper's)"""
    detail: Mapping[str, float] = field(default_factory=dict)
    """by region of the model: 1 lets detail in, 0 keeps the low frequencies; 1 where not named"""


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
