"""Photo -> fitted face: landmarks, model, crop and fit in sequence."""

import functools
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Float
from jaxface.energies.term import Term
from jaxface.imaging.colour import srgb_to_linear
from jaxface.imaging.masks import dilate, fill_polygon
from jaxface.io.face_models import load_model
from jaxface.io.formats.image import Photo, read_image
from jaxface.models.landmark_schemes import CONTOURS, landmarks68
from jaxface.models.morphable import MorphableModel, SurfacePoints
from jaxface.models.parameters import FaceParameters
from jaxface.pipeline.fitting._detail_levels import prepared_levels
from jaxface.pipeline.fitting.levels import compiling_levels, fit_levels
from jaxface.run.clock import Clock
from jaxface.solvers.finiteness import require_finite
from jaxface.stages.fit import (
    FitConfig,
    FitModel,
    FitRender,
    FitStats,
    FitWeights,
    Posterior,
    WorkingPhoto,
    input_shapes,
    posterior,
    render_fit,
    skin_map,
    working_photo,
)
from jaxface.stages.landmarks import detect_one

_posterior_program = jax.jit(posterior)
_skin_program = jax.jit(skin_map)


@jax.jit
def _shape_program(model: MorphableModel, y: FaceParameters) -> Float[Array, "n 3"]:
    return model.shape(y.identity, y.expression)


@jax.jit
def _landmark_program(
    model: MorphableModel, points: SurfacePoints, y: FaceParameters, principal: Float[Array, "2"]
) -> Float[Array, "l 2"]:
    posed = y.pose(points(model.shape(y.identity, y.expression)))
    return y.camera(principal).project(posed)[:, :2]


@dataclass(frozen=True)
class FittedFace:
    """A photo, the model, and what the fit found."""

    photo: Float[np.ndarray, "h w 3"]
    """linear RGB"""
    working: WorkingPhoto
    landmarks: Float[np.ndarray, "l 2"]
    """detected or given, px of the photo"""
    models: tuple[FitModel, ...]
    """level of detail for each pyramid level; the last is the finest"""
    parameters: FaceParameters
    stats: FitStats
    posterior: Posterior
    clock: Clock

    @property
    def model(self) -> MorphableModel:
        """The finest level of detail."""
        return self.models[-1].model

    @property
    def vertices(self) -> Float[Array, "n 3"]:
        """Fitted shape in the model's frame, mm."""
        return _shape_program(self.model, self.parameters)

    @property
    def size(self) -> int:
        """Side of the working image, px."""
        return self.working.data.image.shape[0]

    @property
    def fitted_landmarks(self) -> Float[np.ndarray, "l 2"]:
        """Where the fitted mesh has the landmarks, px of the photo (contours not slid)."""
        finest, principal = self.models[-1], self.working.data.principal
        points = _landmark_program(finest.model, finest.points, self.parameters, principal)
        return self.working.crop.to_photo(np.asarray(points))

    def landmark_error(self) -> float:
        """Mean distance over the inner 51 of the 68 points, over that of the outer eye corners."""
        found, fitted = self.landmarks, self.fitted_landmarks
        if len(found) == 468:
            found, fitted = (
                np.asarray(landmarks68(jnp.asarray(p, jnp.float32))) for p in (found, fitted)
            )
        distance = np.linalg.norm(found[17:] - fitted[17:], axis=1).mean()
        return float(distance / np.linalg.norm(found[36] - found[45]))

    def render(self) -> FitRender:
        """Render the fit as the working image sees it."""
        program = _render_program(self.size)
        principal = self.working.data.principal
        return self.clock.run("render", program, self.parameters, self.models[-1], principal)

    def skin_map(self) -> Float[np.ndarray, "s s"]:
        """Pixels of the working image that show skin, 0 to 1: less hair, hands and glasses."""
        data = self.working.data
        if not bool(data.estimate_inliers):
            return np.asarray(data.mask)
        rendered = self.render()
        shown = self.clock.run("skin", _skin_program, rendered, data.image, data.mask)
        if len(self.landmarks) != 468:
            return np.asarray(shown)
        # Brows differ from the model's more than any skin does, and yet belong to the face.
        points = jnp.asarray(data.landmarks * self.size)
        brows = _brow_program(self.size)(points) * data.mask * rendered.skin
        return np.maximum(np.asarray(shown), np.asarray(brows))


@functools.cache
def _brow_program(size: int) -> Any:
    def inside(points: Float[Array, "468 2"]) -> Array:
        lines = [points[jnp.asarray(CONTOURS[f"{side} brow"])] for side in ("left", "right")]
        filled = [fill_polygon(line, size, size) for line in lines]
        return dilate(filled[0] | filled[1], size / 50)

    return jax.jit(inside)


@functools.cache
def _render_program(size: int) -> Any:
    return jax.jit(lambda y, model, principal: render_fit(y, model, principal, size))


def parse_weights(text: str) -> FitWeights:
    """Weights from text such as ``landmark=20,prior=1e-5``; the others keep their defaults.

    Raises:
        ValueError: an unknown term, or a value that is not a finite number of 0 or more.
    """
    values = {}
    names = tuple(FitWeights.__dataclass_fields__)
    for part in text.split(","):
        name, _, number = (piece.strip() for piece in part.partition("="))
        try:
            value = float(number)
        except ValueError:
            value = float("nan")
        if name not in names or not (np.isfinite(value) and value >= 0):
            raise ValueError(
                f"weights has {part.strip()!r}; NAME=NUMBER is needed, the names being "
                f"{', '.join(names)} and the numbers 0 or more"
            )
        values[name] = value
    return FitWeights(**values)


def as_photo(photo: str | os.PathLike[str] | Photo | np.ndarray) -> Photo:
    """A photo from a file or an array (``uint8`` or sRGB-encoded floats in [0, 1]).

    Raises:
        ValueError: an array that is not (h, w, 3) of one of these kinds, or has NaN.
        FileNotFoundError: there is no such file.
    """
    if isinstance(photo, Photo):
        return photo
    if not isinstance(photo, np.ndarray):
        return read_image(photo)
    if photo.ndim != 3 or photo.shape[2] != 3:
        raise ValueError(f"the photo has shape {photo.shape}; (height, width, 3) RGB is needed")
    if photo.dtype == np.uint8:
        pixels = photo.astype(np.float32) / 255
    elif np.issubdtype(photo.dtype, np.floating):
        pixels = photo.astype(np.float32)
        if not np.isfinite(pixels).all() or pixels.min() < 0 or pixels.max() > 1:
            raise ValueError("a photo of floats needs finite sRGB-encoded values from 0 to 1")
    else:
        raise ValueError(f"the photo is {photo.dtype}; uint8 or floats in [0, 1] are needed")
    return Photo(pixels, None, None, "array")


def fit(
    photo: str | os.PathLike[str] | Photo | np.ndarray,
    model: str | os.PathLike[str] | MorphableModel = "makehuman",
    *,
    landmarks: Float[np.ndarray, "l 2"] | None = None,
    mask: Float[np.ndarray, "h w"] | None = None,
    face: int | None = None,
    detector: Callable[..., Any] = detect_one,
    weights: FitWeights | None = None,
    steps: Sequence[int] = (30, 10, 3),
    size: int = 512,
    details: Sequence[int] | None = None,
    extra_terms: Sequence[Term] = (),
    self_shadow: bool = True,
    shadow_directions: int = 256,
    clock: Clock | None = None,
) -> FittedFace:
    """Fit a morphable model to a photo (Saito 2017, section 3).

    Args:
        photo: file, or (h, w, 3) array, ``uint8`` or sRGB-encoded floats.
        model: bundled name, model file, or model.
        landmarks: 68 or 468 points, px; detected if not given.
        mask: (h, w) valid face pixels; by default the face oval less what is not skin.
        face: which face, from the largest (0), where the photo shows several.
        detector: ``detector(pixels, face)`` with an answer that has ``landmarks`` (468, 2 or 3).
        weights: of the terms; `FitWeights()` by default.
        steps: Gauss-Newton steps on each pyramid level, coarsest first.
        size: side of the working image, px.
        details: subdivisions of the model at each level (``detail_levels``).
        extra_terms: your own terms, functions of ``(FaceParameters, FitData)``.
        self_shadow: whether the shading lacks what the face hides from itself of the light
            (``render.occlusion``, of the mean face); the paper's does not.
        shadow_directions: directions of light whose hard shadows on the face are followed
            (`cast_shadows`); 0, or no ``self_shadow``: soft ones only.
        clock: where times are noted.

    Raises:
        ValueError: no face, several faces, or an argument that does not fit; the message says
            which.
        FileNotFoundError: a file that does not exist.
    """
    clock = clock or Clock()
    if not steps or min(steps) < 0 or size % 2 ** (len(steps) - 1) or size < 64:
        raise ValueError(
            f"steps {tuple(steps)} at size {size}: needed one or more non-negative counts and a "
            f"size of 64 or more that halves {max(len(steps) - 1, 0)} times"
        )
    seen = clock.host("read photo", as_photo, photo)
    if not isinstance(model, MorphableModel):
        model = clock.host("load model", load_model, model)
    weights = weights or FitWeights()
    config = FitConfig(
        steps=tuple(steps), extra_terms=tuple(extra_terms), shadow_directions=shadow_directions
    )

    if landmarks is None:
        count = 68 if model.landmarks468 is None else 468
    else:
        count = len(landmarks)
    models = clock.host(
        "prepare model", prepared_levels, model, self_shadow, count, len(steps), details
    )
    # The programs take longest: they are compiled while the detector looks.
    with compiling_levels(clock, input_shapes(size, count), models, weights, config):
        if landmarks is None:
            found = clock.host("detect landmarks", detector, seen.pixels, face)
            landmarks = np.asarray(found.landmarks)[:, :2]
            if model.landmarks468 is None:
                landmarks = np.asarray(landmarks68(jnp.asarray(landmarks, jnp.float32)))
        landmarks = np.asarray(landmarks, np.float64)[:, :2]
        linear = np.asarray(srgb_to_linear(jnp.asarray(seen.pixels)))
        focal = None
        if seen.focal_35mm:
            focal = seen.focal_35mm / 36.0 * max(linear.shape[:2])
        working = clock.host(
            "crop", working_photo, linear, landmarks, mask=mask, focal=focal, size=size
        )
    parameters, stats, models = fit_levels(clock, working.data, models, weights, config)
    for not_finite in stats.not_finite:
        require_finite(not_finite, "the fit")
    if not all(np.isfinite(np.asarray(x)).all() for x in jax.tree.leaves(parameters)):
        raise ValueError("the fit did not stay finite; check the photo and the model for NaN")
    spread = clock.run(
        "posterior", _posterior_program, stats.curvature, models[-1].model, weights.prior
    )
    return FittedFace(linear, working, landmarks, models, parameters, stats, spread, clock)
