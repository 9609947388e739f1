"""What goes into a fit, what one step holds fixed, and what comes out."""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp

from jaxface._types import Array, Float, PyTree
from jaxface.energies.landmark import LandmarkData
from jaxface.energies.photometric import PhotometricData, PixelSamples
from jaxface.energies.term import Term
from jaxface.models.parameters import FaceParameters


class FitWeights(eqx.Module):
    """Weights of the terms; the first three as in Saito 2017."""

    photo: float | Array = 1.0
    landmark: float | Array = 10.0
    prior: float | Array = 2.5e-5
    noise: float | Array = 0.03
    """``E_c`` (linear RGB, face at median 0.5) at which the photo term has its own weight: it
    counts ``noise / E_c``, the more the better the model explains the photo; 0 gives the paper's
    constant weight"""
    landmark_scale: float | Array = 0.025
    """distance (of the eye distance) at which a landmark counts half, as an outlier does; 0
    gives the paper's plain squares"""
    landmark_turn: float | Array = 4.0
    """power of the cosine of the head's turn from the camera, over that of 20 degrees, with which
    the landmark term counts beyond that: on renders the detector's error grows like this from 20 to
    40 degrees; 0 gives the paper's constant weight"""
    focal: float | Array = 2.5e-5
    """of the prior on the focal length (not in the paper)"""
    light: float | Array = 2.5e-5
    """of the damping of the light's upper bands (not in the paper)"""
    extra: Mapping[str, float | Array] = eqx.field(default_factory=dict)
    """of your own terms, by name (``weights_as_data``)"""

    @classmethod
    def as_published(cls) -> "FitWeights":
        """Those of equation 1 of Saito 2017 alone: constants, plain squares, no other prior."""
        return cls(noise=0.0, landmark_scale=0.0, landmark_turn=0.0, focal=0.0, light=0.0)

    @classmethod
    def from_text(cls, text: str) -> "FitWeights":
        """From text such as ``landmark=20,prior=1e-5``; the others keep their defaults.

        Raises:
            ValueError: an unknown term, or a value that is not a finite number of 0 or more.
        """
        values = {}
        names = tuple(part.name for part in dataclasses.fields(cls) if part.name != "extra")
        for part in text.split(","):
            name, _, number = (piece.strip() for piece in part.partition("="))
            try:
                value = float(number)
            except ValueError:
                value = math.nan
            if name not in names or not (math.isfinite(value) and value >= 0):
                raise ValueError(
                    f"weights has {part.strip()!r}; NAME=NUMBER is needed, the names being "
                    f"{', '.join(names)} and the numbers 0 or more"
                )
            values[name] = value
        return cls(**values)


class FitConfig(eqx.Module):
    """Settings of a fit that are fixed at compile time."""

    steps: tuple[int, ...] = eqx.field(static=True, default=(30, 10, 3))
    """Gauss-Newton steps on each pyramid level, coarsest first"""
    landmark_steps: int = eqx.field(static=True, default=15)
    """steps on landmarks and prior alone, before the first level"""
    compared_pixels: int = eqx.field(static=True, default=32768)
    """pixels (evenly spread) on which energy and gradient are formed, at most"""
    curvature_pixels: int = eqx.field(static=True, default=3000)
    """pixels (evenly spread) of these on which the Jacobian is formed"""
    shadow_directions: int = eqx.field(static=True, default=256)
    """directions of light whose hard shadows are followed (``cast_shadows``); 0: soft ones only"""
    rtol: float = eqx.field(static=True, default=1e-5)
    extra_terms: tuple[Term, ...] = eqx.field(static=True, default=())
    """your own terms, functions of ``(FaceParameters, FitData)``"""
    freeze: tuple[str, ...] = eqx.field(static=True, default=())
    """fields of ``FaceParameters`` that stay as they are at the start"""
    follow_contour: bool = eqx.field(static=True, default=True)
    """whether contour landmarks slide along the silhouette, and those on surface that turns away
    lose weight (``slide_contour``); else each stays at its own point, as equation 1 has it"""


class FitInput(eqx.Module):
    """One photo, cut to the working image, and what was detected on it."""

    image: Float[Array, "s s 3"]
    """linear RGB"""
    mask: Float[Array, "s s"]
    """valid face pixels, 0 to 1"""
    landmarks: Float[Array, "l 2"]
    """(x, y) as fractions of the side"""
    landmark_weight: Float[Array, "l"]
    landmark_unit: Float[Array, ""]
    """outer eye corners' distance, as a fraction of the side"""
    principal: Float[Array, "2"]
    """principal point, as fractions of the side"""
    log_focal: Float[Array, ""]
    """prior mean of the logarithm of the focal length over the side"""
    log_focal_deviation: Float[Array, ""]
    estimate_inliers: Array
    """True: hair, hands and glasses are looked for in the mask; False: the mask is trusted"""
    user: PyTree = None
    """arrays of your own, for your own terms"""


class FitData(eqx.Module):
    """What one Gauss-Newton step holds fixed: visible pixels, landmarks, priors."""

    photo: PhotometricData
    photo_trust: Float[Array, ""]
    """``noise / E_c``: a Laplacian of unknown width has ``log E_c`` for its likelihood"""
    curvature_samples: PixelSamples
    landmark: LandmarkData
    landmark_trust: Float[Array, ""]
    """less than 1 where the head turns from the camera"""
    normal_modes: Float[Array, "n 3 k"]
    """derivative of the vertex normals along the shape modes, from the start of the level"""
    focal_prior: tuple[Array, Array]
    weights: FitWeights
    """of the terms"""
    user: PyTree = None
    """your own, from ``FitInput``"""
    held: FaceParameters | None = None
    """values of the frozen unknowns, the others None; None where all are free"""


class FitStats(eqx.Module):
    """History of a fit, one entry a level.

    The first entry is the landmark-only start's, unless the fit was begun elsewhere.
    """

    energies: tuple[dict[str, Array], ...]
    """per level: energy of every term before each step and after the last, one entry more than the
    most steps of any level, infinite where unused"""
    steps: tuple[Array, ...]
    """steps used on each level"""
    curvature: Float[Array, "p p"]
    """of the energy, from the last step of the finest level: half its Gauss-Newton Hessian; zero
    in rows and columns of unknowns that were frozen"""
    occlusion: Float[Array, "n 9"] | None = None
    """transfer of self-occlusion that the finest level was fitted with"""
    occlusion_slope: Float[Array, "n 3 9"] | None = None
    """its slope in the vertex normals"""
    not_finite: tuple[dict[str, Array], ...] = ()
    """per level, what was not finite where it stopped (``solvers.Solution``)"""


def no_history() -> FitStats:
    """That of parameters which no fit of this process has found: no level, no curvature."""
    return FitStats((), (), jnp.zeros((0, 0)))


class LevelRecord(eqx.Module):
    """What one level leaves behind besides the parameters."""

    energies: dict[str, Array]
    steps: Array
    curvature: Float[Array, "p p"]
    not_finite: dict[str, Array] = eqx.field(default_factory=dict)


def join_records(
    records: Sequence[LevelRecord],
    occlusion: Float[Array, "n 9"] | None = None,
    occlusion_slope: Float[Array, "n 3 9"] | None = None,
) -> FitStats:
    """The history of a fit from those of its levels, the landmark-only start first."""
    return FitStats(
        tuple(r.energies for r in records),
        tuple(r.steps for r in records),
        records[-1].curvature,
        occlusion,
        occlusion_slope,
        tuple(r.not_finite for r in records),
    )
