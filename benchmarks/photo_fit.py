"""One photo to an `Estimate`, by the package's own journey from photo to fit."""

import jax.numpy as jnp
import numpy as np
from fit_metrics import Estimate

from jaxface.geometry.rotation import rotation_matrix
from jaxface.models.landmark_schemes import landmarks68
from jaxface.models.morphable import MorphableModel
from jaxface.pipeline import Clock, FittedFace, fit
from jaxface.stages.fit import FitWeights


def estimate_of(fitted: FittedFace, clock: Clock) -> Estimate:
    """The figures of a fit that truth is known for, and its time."""
    y, data, crop = fitted.parameters, fitted.working.data, fitted.working.crop
    points = y.pose(fitted.model.landmarks68(fitted.vertices))
    screen = np.asarray(y.camera(data.principal).project(points))[:, :2]
    detected = np.asarray(fitted.landmarks, np.float32)
    if len(detected) == 468:
        detected = np.asarray(landmarks68(jnp.asarray(detected)))
    return Estimate(
        identity=np.asarray(y.identity),
        expression=np.asarray(y.expression),
        albedo=np.asarray(y.albedo),
        light=np.asarray(y.light),
        rotation=np.asarray(rotation_matrix(y.rotation)),
        landmarks=crop.to_photo(screen),
        detected=detected,
        seconds=clock.seconds["fit"],
    )


def fit_photo(
    photo: np.ndarray,
    model: MorphableModel,
    details: tuple[int, ...] | None = None,
    weights: FitWeights | None = None,
) -> Estimate:
    """Fit a photo (uint8 sRGB) from detected landmarks with the default steps."""
    clock, weights = Clock(), weights or FitWeights()
    fitted = fit(photo, model, details=details, weights=weights, clock=clock)
    return estimate_of(fitted, clock)
