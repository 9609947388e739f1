"""The pictures of a fit: a contact sheet to judge it by."""

import numpy as np

from jaxface._types import Bool, Float
from jaxface.io.formats.exr import srgb_encoded
from jaxface.io.pictures.drawing import draw_landmarks
from jaxface.io.pictures.overlay import contact_sheet, heatmap

_LIGHT = np.array([0.3, 0.5, 0.81])


def fit_sheet(
    photo: Float[np.ndarray, "s s 3"],
    color: Float[np.ndarray, "s s 3"],
    albedo: Float[np.ndarray, "s s 3"],
    normal: Float[np.ndarray, "s s 3"],
    covered: Bool[np.ndarray, "s s"],
    skin: Bool[np.ndarray, "s s"],
    deviation: Float[np.ndarray, "s s"],
    detected: Float[np.ndarray, "l 2"],
    fitted: Float[np.ndarray, "l 2"],
    heading: str = "",
) -> np.ndarray:
    """Photo, landmarks, render over the photo, geometry, albedo, residual, uncertainty.

    Args:
        photo: working image, linear RGB.
        color: render in the same exposure, linear RGB.
        albedo: rendered albedo, linear RGB.
        normal: unit normals in the camera's frame.
        covered: pixels that the mesh covers.
        skin: pixels that the photo term may compare.
        deviation: standard deviation of the surface, mm.
        detected: landmarks found in the photo, px of the working image.
        fitted: the same points of the fitted mesh.
        heading: line above the sheet.
    """
    bright = np.quantile(photo.max(axis=-1), 0.98)
    exposure = 1.0 / max(float(bright), 1e-6)

    def shown(linear: np.ndarray) -> np.ndarray:
        return srgb_encoded(np.asarray(linear) * exposure)

    picture = shown(photo)
    points = draw_landmarks(picture, detected, (60, 230, 90))
    points = draw_landmarks(points, fitted, (255, 70, 50))
    shade = 0.15 + 0.75 * np.clip(normal @ (_LIGHT / np.linalg.norm(_LIGHT)), 0, 1)
    clay = np.where(covered[..., None], srgb_encoded(shade[..., None] * np.ones(3)), picture)
    residual = np.linalg.norm(photo - color, axis=-1) * exposure
    return contact_sheet(
        [
            ("photo", picture),
            ("landmarks: found (green), fitted (red)", points),
            ("render over photo", np.where(skin[..., None], shown(color), picture)),
            ("whole head", np.where(covered[..., None], shown(color), picture)),
            ("geometry", clay),
            ("albedo", np.where(covered[..., None], srgb_encoded(albedo), 1.0)),
            ("residual (linear RGB)", heatmap(residual, 0.0, 0.3, mask=skin)),
            ("standard deviation", heatmap(deviation, 0.0, None, mask=covered, unit="mm")),
        ],
        columns=4,
        heading=heading,
    )
