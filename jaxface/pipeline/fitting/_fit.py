"""Photo -> fitted face: landmarks, model, crop and fit in sequence."""

import dataclasses
import os
from collections.abc import Callable
from typing import Any, Unpack

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import Float, PyTree
from jaxface.imaging.colour import srgb_to_linear
from jaxface.io.face_models import load_model
from jaxface.io.formats.image import Photo
from jaxface.models.landmark_schemes import landmarks68
from jaxface.models.morphable import MorphableModel
from jaxface.models.parameters import PARAMETER_NAMES, FaceParameters, neutral_parameters
from jaxface.pipeline.fitting._detail_levels import prepared_levels
from jaxface.pipeline.fitting.fitted_face import FittedFace
from jaxface.pipeline.fitting.levels import compiling_levels, fit_levels
from jaxface.pipeline.photo import as_photo
from jaxface.run.clock import Clock
from jaxface.run.compile_cache import keep_compiled
from jaxface.solvers import require_finite
from jaxface.stages.fit import (
    FitStats,
    WorkingPhoto,
    in_units_of,
    input_shapes,
    weights_as_data,
    working_photo,
)
from jaxface.stages.fit.options import FitOptions, FitOverrides
from jaxface.stages.landmarks import detect_one


def fit(
    photo: str | os.PathLike[str] | Photo | np.ndarray,
    model: str | os.PathLike[str] | MorphableModel = "makehuman",
    options: FitOptions | None = None,
    *,
    landmarks: Float[np.ndarray, "l d"] | None = None,
    mask: Float[np.ndarray, "h w"] | None = None,
    detector: Callable[..., Any] = detect_one,
    start: FaceParameters | FittedFace | None = None,
    user: PyTree = None,
    clock: Clock | None = None,
    **overrides: Unpack[FitOverrides],
) -> FittedFace:
    """Fit a morphable model to a photo (Saito 2017, section 3).

    Compiled programs are kept for the next process (``enable_compilation_cache``).

    Args:
        photo: file, or (h, w, 3) array, ``uint8`` or sRGB-encoded floats.
        model: bundled name, model file, or model.
        options: the settings; `FitOptions` says what there is, `FitOptions()` being the default.
        landmarks: 68 or 468 points, px, with a third number where there is a depth; detected if
            not given.
        mask: (h, w) valid face pixels; by default the face oval less what is not skin.
        detector: ``detector(pixels, face)`` with an answer that has ``landmarks`` (468, 2 or 3).
        start: where to begin, in place of the landmarks alone: the unknowns of another fit, in
            units of this one's working image; or that fit itself, of this photo or of another by
            the same camera, whose units are then converted.
        user: arrays of your own in any pytree, which your own terms find as ``data.user``.
        clock: where times are noted.
        overrides: single settings, by their names in ``options``, as ``size=256``.

    Raises:
        TypeError: an override that is no setting.
        ValueError: no face, several faces, an argument that does not fit, or a term that is not
            finite; the message says which.
        FileNotFoundError: a file that does not exist.
    """
    options = dataclasses.replace(options or FitOptions(), **overrides)
    clock = clock or Clock()
    keep_compiled()
    weights, terms = weights_as_data(options.weights, options.extra_terms)
    config = dataclasses.replace(options.config(), extra_terms=terms)
    seen = clock.host("read photo", as_photo, photo)
    if not isinstance(model, MorphableModel):
        model = clock.host("load model", load_model, model)
    user = jax.tree.map(jnp.asarray, user)

    count = 468 if model.landmarks468 is not None else 68
    if landmarks is not None:
        count = len(landmarks)
    models = clock.host(
        "prepare model", prepared_levels, model, options.self_shadow, count, len(options.steps),
        options.details,
    )  # fmt: skip
    shapes = dataclasses.replace(
        input_shapes(options.size, count),
        user=jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), user),
    )
    begun = None if start is None else jax.eval_shape(neutral_parameters, model)
    # The programs take longest: they are compiled while the detector looks.
    with compiling_levels(clock, shapes, models, weights, config, begun):
        if landmarks is None:
            found = clock.host("detect landmarks", detector, seen.pixels, options.face)
            landmarks = np.asarray(found.landmarks)
            if model.landmarks468 is None:
                landmarks = np.asarray(landmarks68(jnp.asarray(landmarks, jnp.float32)))
        points = np.asarray(landmarks, np.float64)
        if points.ndim != 2 or points.shape[1] not in (2, 3):
            raise ValueError(f"landmarks has shape {points.shape}; (68 or 468, 2 or 3) is needed")
        linear = np.asarray(srgb_to_linear(jnp.asarray(seen.pixels)))
        working = clock.host(
            "crop", working_photo, linear, points[:, :2], mask=mask,
            focal=_focal_px(options.focal or seen.focal_35mm, linear), size=options.size,
            estimate_inliers=options.estimate_inliers, even_landmarks=options.even_landmarks,
        )  # fmt: skip
        working = working._replace(data=dataclasses.replace(working.data, user=user))
        y = None if start is None else _begun(start, model, working, options)
    y, stats, models = fit_levels(clock, working.data, models, weights, config, y)
    _check_finite(y, stats)
    fitted = FittedFace(
        linear, working, points[:, :2], models, y, stats, options,
        points[:, 2] if points.shape[1] > 2 else None,
    )  # fmt: skip
    fitted.estimate_posterior(clock)
    return fitted


def _check_finite(y: FaceParameters, stats: FitStats) -> None:
    """Refuse a fit one of whose terms was not finite, at any step of any level.

    The solver takes no step that it cannot compare, so that such a fit is a start given back.
    """
    for flags, history, used in zip(stats.not_finite, stats.energies, stats.steps, strict=True):
        told = {}
        for name, flag in flags.items():
            values = np.asarray(history[name])[: int(used) + 1]
            # A step to where a term is not finite is one that was not taken.
            told[name] = jnp.asarray(flag) & jnp.array([not np.isfinite(values).all(), True, True])
        require_finite(told, "the fit")
    if not all(np.isfinite(np.asarray(x)).all() for x in jax.tree.leaves(y)):
        raise ValueError("the fit did not stay finite; check the photo and the model for NaN")


def _focal_px(focal_35mm: float | None, photo: np.ndarray) -> float | None:
    return focal_35mm / 36.0 * max(photo.shape[:2]) if focal_35mm else None


def _begun(
    start: FaceParameters | FittedFace,
    model: MorphableModel,
    working: WorkingPhoto,
    options: FitOptions,
) -> FaceParameters:
    """The unknowns to begin with, in units of the working image."""
    y = start.parameters if isinstance(start, FittedFace) else start
    neutral = neutral_parameters(model)
    for name in PARAMETER_NAMES:
        given, shape = np.asarray(getattr(y, name)), getattr(neutral, name).shape
        if given.shape != shape or not np.isfinite(given).all():
            raise ValueError(
                f"start has {name} of shape {given.shape}; finite numbers of shape {shape} are "
                f"needed for the model {model.name!r}"
            )
    y = jax.tree.map(lambda x, like: jnp.asarray(x, like.dtype), y, neutral)
    if isinstance(start, FittedFace):
        y = in_units_of(working, y, start.working)
    if options.focal is not None:
        y = eqx.tree_at(lambda p: p.log_focal, y, working.data.log_focal)
    return y
