"""How a photo is fitted: every setting with its default, checked."""

import dataclasses
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypedDict

import numpy as np

from jaxface.energies.term import Term
from jaxface.models.parameters import PARAMETER_NAMES
from jaxface.stages.fit.photo import WORKING_SIZE
from jaxface.stages.fit.records import FitConfig, FitWeights

SMALLEST_SIZE = 64
"""px along a side of the working image"""


class FitOverrides(TypedDict, total=False):
    """The fields of `FitOptions` as keywords, for functions that pass them on."""

    steps: Sequence[int]
    size: int
    weights: FitWeights
    details: Sequence[int] | None
    face: int | None
    focal: float | None
    freeze: Sequence[str]
    extra_terms: Sequence[Term]
    self_shadow: bool
    shadow_directions: int
    estimate_inliers: bool
    even_landmarks: bool
    follow_contour: bool
    landmark_steps: int
    compared_pixels: int | None
    curvature_pixels: int | None
    rtol: float


@dataclass(frozen=True)
class FitOptions:
    """Settings of `fit`. Another value for one of them: ``dataclasses.replace``.

    Raises:
        TypeError: a name that is none of the fields.
        ValueError: a value that does not fit; the message says which and what is needed.
    """

    steps: Sequence[int] = field(
        default=FitConfig.steps, metadata={"help": "Steps on each pyramid level, coarsest first."}
    )
    """Gauss-Newton steps on each pyramid level, coarsest first"""
    size: int = field(default=WORKING_SIZE, metadata={"help": "Side of the working image, px."})
    """side of the working image, px; halved for each coarser level"""
    weights: FitWeights = field(default_factory=FitWeights)
    """of the terms"""
    details: Sequence[int] | None = field(
        default=None, metadata={"help": "Subdivisions of the model at each level, as 0,1,2."}
    )
    """subdivisions of the model at each level; None: by its number of vertices
    (``detail_levels``)"""
    face: int | None = field(
        default=None, metadata={"help": "Which face, from the largest (0), if there are several."}
    )
    """which face, from the largest (0), where the photo shows several"""
    focal: float | None = field(
        default=None, metadata={"help": "Focal length that is known, mm for a frame 36 mm wide."}
    )
    """focal length that is known, as of a lens for 35 mm film: mm for a frame 36 mm wide. It is
    held. For one in pixels of the photo give ``36 * pixels / max(width, height)``. None: the
    photo's file, or else a normal lens, is the middle of a weak prior"""
    freeze: Sequence[str] = ()
    """fields of ``FaceParameters`` that stay as they are at the start: that of ``fit(start=...)``,
    or else no expression and the mean's shape and albedo, and pose and light in closed form"""
    extra_terms: Sequence[Term] = ()
    """your own terms, functions of ``(FaceParameters, FitData)``; weights that are numbers are data
    of the compiled program, so that another needs no other"""
    self_shadow: bool = field(
        default=True,
        metadata={
            "help": "Shade with what the face hides from itself of the light, or as the paper."
        },
    )
    """whether the shading lacks what the face hides from itself of the light
    (``render.occlusion``, of the mean face)"""
    shadow_directions: int = FitConfig.shadow_directions
    """directions of light whose hard shadows on the face are followed (``cast_shadows``); 0, or no
    ``self_shadow``: soft ones only"""
    estimate_inliers: bool = True
    """whether hair, hands and glasses are looked for where no mask is given"""
    even_landmarks: bool = False
    """whether all landmarks count alike, and not those on smooth skin less"""
    follow_contour: bool = FitConfig.follow_contour
    """whether contour landmarks slide along the silhouette and hidden ones lose weight"""
    landmark_steps: int = FitConfig.landmark_steps
    """steps on landmarks and prior alone, before the first level"""
    compared_pixels: int | None = FitConfig.compared_pixels
    """pixels on which energy and gradient are formed, at most; None: all"""
    curvature_pixels: int | None = FitConfig.curvature_pixels
    """pixels of these on which the Jacobian is formed, at most; None: all"""
    rtol: float = FitConfig.rtol
    """a level ends when a step lowers the energy by less than this share of it"""

    def __post_init__(self):
        for name in ("steps", "details", "freeze", "extra_terms"):
            value = getattr(self, name)
            if isinstance(value, str):
                raise ValueError(f"{name} is {value!r}; a sequence is needed, as ({value!r},)")
            if value is not None:
                object.__setattr__(self, name, tuple(value))
        self._check_levels()
        self._check_terms()
        known = set(PARAMETER_NAMES)
        if not set(self.freeze) < known:
            raise ValueError(
                f"freeze is {list(self.freeze)}; some of {list(PARAMETER_NAMES)} are needed, and "
                "not all of them"
            )
        if self.focal is not None and not (np.isfinite(self.focal) and self.focal > 0):
            raise ValueError(f"focal is {self.focal}; a positive length in mm is needed")
        counts = ("face", "shadow_directions", "landmark_steps")
        for name, least in (*dict.fromkeys(counts, 0).items(), ("compared_pixels", 1),
                            ("curvature_pixels", 1)):  # fmt: skip
            value = getattr(self, name)
            if value is not None and not _whole(value, least):
                raise ValueError(
                    f"{name} is {value!r}; a whole number of {least} or more is needed"
                )
        if not (np.isfinite(self.rtol) and self.rtol >= 0):
            raise ValueError(f"rtol is {self.rtol}; a finite number of 0 or more is needed")

    def _check_levels(self) -> None:
        steps, size = self.steps, self.size
        halvings = max(len(steps) - 1, 0)
        fits = _whole(size, SMALLEST_SIZE) and size % 2**halvings == 0
        if not steps or not all(_whole(n, 0) for n in steps) or not fits:
            raise ValueError(
                f"steps {tuple(steps)} at size {size}: needed one or more non-negative counts and "
                f"a size of {SMALLEST_SIZE} or more that halves {halvings} times"
            )
        details = self.details
        if details is not None and (
            len(details) != len(steps)
            or not all(_whole(n, 0) for n in details)
            or list(details) != sorted(details)
        ):
            raise ValueError(
                f"details is {list(details)}; {len(steps)} subdivision counts, not decreasing, are "
                "needed"
            )

    def _check_terms(self) -> None:
        if not isinstance(self.weights, FitWeights):
            raise ValueError(f"weights is {self.weights!r}; a FitWeights is needed")
        for part in dataclasses.fields(self.weights):
            value = getattr(self.weights, part.name)
            named = value if isinstance(value, Mapping) else {part.name: value}
            for name, weight in named.items():
                _check_weight(f"weights.{name}", weight)
        for term in self.extra_terms:
            if not isinstance(term, Term):
                raise ValueError(f"extra_terms has {term!r}; a Term is needed")
            if not callable(term.weight):
                _check_weight(f"the weight of the term {term.name!r}", term.weight)

    @classmethod
    def as_published(cls, **others: Any) -> "FitOptions":
        """Section 3 of Saito 2017 as it is written: every departure from it switched off.

        Equation 1 with its three terms and constant weights, plain squares of all landmarks at
        their own points, all pixels of the mask, and no shadow in the shading. The mask stands for
        the paper's learnt segmentation: give that as ``fit(mask=...)``, or it is the face's
        outline. What remains is the way to the minimum: damped steps, visibility found anew before
        each, and a start from the landmarks alone. Curvature on all pixels of 512 px takes some
        gigabytes; ``curvature_pixels`` changes only the way.

        Args:
            others: further fields.
        """
        published: dict[str, Any] = {
            "weights": FitWeights.as_published(),
            "self_shadow": False,
            "shadow_directions": 0,
            "estimate_inliers": False,
            "even_landmarks": True,
            "follow_contour": False,
            "compared_pixels": None,
            "curvature_pixels": None,
        }
        return cls(**{**published, **others})

    def config(self) -> FitConfig:
        """What is fixed at compile time, with the extra terms as they are given."""
        every = self.size * self.size // 2
        freeze = {*self.freeze, *(() if self.focal is None else ("log_focal",))}
        return FitConfig(
            steps=tuple(self.steps),
            landmark_steps=self.landmark_steps,
            compared_pixels=self.compared_pixels or every,
            curvature_pixels=self.curvature_pixels or every,
            shadow_directions=self.shadow_directions,
            rtol=self.rtol,
            extra_terms=tuple(self.extra_terms),
            freeze=tuple(name for name in PARAMETER_NAMES if name in freeze),
            follow_contour=self.follow_contour,
        )

    def changed(self) -> dict[str, Any]:
        """The fields that differ from their defaults."""
        usual = FitOptions()
        values = {part.name: getattr(self, part.name) for part in dataclasses.fields(self)}
        return {name: value for name, value in values.items() if value != getattr(usual, name)}


def _whole(value: Any, least: int) -> bool:
    try:
        return operator.index(value) >= least
    except TypeError:
        return False


def _check_weight(what: str, weight: Any) -> None:
    value = np.asarray(weight)
    if value.shape != () or not (np.isfinite(value) and value >= 0):
        raise ValueError(f"{what} is {weight}; a finite number of 0 or more is needed")
