"""How far a fit is from the truth: shape in millimetres, albedo and light up to their scale.

The face region is the skin that a frontal photo shows: vertices that are visible from the front on
the mean face, within ``RADIUS`` of the tip of the nose and labelled as skin of the face where the
model has such labels (no eyeballs, inner mouth, ears, scalp, neck).
"""

from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxface.geometry.camera import Camera
from jaxface.geometry.rotation import similarity_transform
from jaxface.models.morphable import MorphableModel
from jaxface.render._rasterize import rasterize
from jaxface.render.shading import irradiance

RADIUS = 95.0  # mm
NOSE_TIP = 30  # of the 68 points
NOT_FACE = ("scalp", "ears", "neck", "eyes", "mouth_interior", "head")


@dataclass(frozen=True)
class Estimate:
    """What a fit found, for one photo."""

    identity: np.ndarray
    expression: np.ndarray
    albedo: np.ndarray
    light: np.ndarray
    """(9, 3) irradiance coefficients, camera frame"""
    rotation: np.ndarray
    """(3, 3), model to camera"""
    landmarks: np.ndarray
    """(68, 2) the fitted model's landmarks in the photo, px"""
    detected: np.ndarray
    """(68, 2) the landmarks that the fit started from, px"""
    seconds: float = 0.0


def load_truth(path: Path) -> dict[str, np.ndarray]:
    """The record that ``ground_truth.py`` wrote beside a photo."""
    with np.load(path) as arrays:
        return dict(arrays)


def face_region(model: MorphableModel) -> np.ndarray:
    """Indices of the vertices of the face region (see the module)."""
    if model.landmarks68 is None:
        raise ValueError(f"model {model.name!r} has no 68 landmarks to find its face by")
    mean = np.asarray(model.mean)
    tip = np.asarray(model.landmarks68(model.mean))[NOSE_TIP]
    near = np.linalg.norm(mean - tip, axis=1) < RADIUS
    present = [name for name in NOT_FACE if name in model.region_names]
    if present:
        near &= ~np.asarray(model.region_mask(*present))
    size, distance = 512, 5000.0
    camera = Camera(jnp.asarray(size * distance / 300.0), jnp.array([size / 2.0, size / 2.0]))
    screen = camera.project(jnp.asarray(mean - tip) - jnp.array([0.0, 0.0, distance]))
    triangle = np.unique(np.asarray(rasterize(screen, model.faces, size, size).triangle))
    visible = np.zeros(len(mean), bool)
    visible[np.asarray(model.faces)[triangle[triangle >= 0]]] = True
    return np.flatnonzero(near & visible)


def aligned_distances(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Distances (mm) of corresponding points after the best similarity transform."""
    source, target = jnp.asarray(estimate, jnp.float32), jnp.asarray(truth, jnp.float32)
    scale, rotation, shift = similarity_transform(source, target)
    moved = scale * source @ rotation.T + shift
    return np.asarray(jnp.linalg.norm(moved - target, axis=1))


def relative_error(estimate: np.ndarray, truth: np.ndarray, per_channel: bool) -> float:
    """``min_s |s e - t| / |t|`` with one scale ``s``, or one for each colour channel.

    A photo fixes the product of albedo and light alone: their common brightness is open, and so
    is their common hue but for what the priors say of it.
    """
    axis = 0 if per_channel else None
    scale = np.sum(estimate * truth, axis=axis) / np.maximum(
        np.sum(estimate * estimate, axis=axis), 1e-12
    )
    return float(np.linalg.norm(scale * estimate - truth) / np.linalg.norm(truth))


def projected_landmarks(truth: dict[str, np.ndarray], model: MorphableModel) -> np.ndarray:
    """True positions (68, 2) of the model's landmarks in the photo, px."""
    shape = model.shape(jnp.asarray(truth["identity"]), jnp.asarray(truth["expression"]))
    points = np.asarray(model.landmarks68(shape)) @ truth["rotation"].T + truth["translation"]
    x, y = truth["principal"]
    depth = -points[:, 2]
    return np.stack(
        [x + truth["focal"] * points[:, 0] / depth, y - truth["focal"] * points[:, 1] / depth], 1
    )


def rotation_angle(first: np.ndarray, second: np.ndarray) -> float:
    """Angle between two rotations, degrees."""
    cosine = (np.trace(first @ second.T) - 1) / 2
    return float(np.rad2deg(np.arccos(np.clip(cosine, -1, 1))))


def compare(
    estimate: Estimate, truth: dict[str, np.ndarray], model: MorphableModel, region: np.ndarray
) -> dict[str, float]:
    """All figures of one fit; baselines are the mean face, the mean albedo and ambient light."""
    true_shape = np.asarray(model.shape(truth["identity"], truth["expression"]))[region]
    shape = np.asarray(model.shape(estimate.identity, estimate.expression))[region]
    distance = aligned_distances(shape, true_shape)
    baseline = aligned_distances(np.asarray(model.mean)[region], true_shape)
    albedo = np.asarray(model.reflectance(estimate.albedo))[region]
    mean_albedo = np.asarray(model.albedo_mean)[region]
    if "albedo" in truth:
        true_albedo = truth["albedo"][region]
    else:
        true_albedo = np.asarray(model.reflectance(truth["albedo_coefficients"]))[region]
    # A face shows the half of the sphere that is turned to the camera.
    normals, true_light = truth["sphere_normals"], truth["sphere_irradiance"] / np.pi
    front = normals[:, 2] > 0.1
    light = np.asarray(irradiance(normals, estimate.light))[front]
    true_light = true_light[front]
    points = projected_landmarks(truth, model)
    ocular = np.linalg.norm(points[36] - points[45])
    inner = slice(17, 68)

    def gap(a: np.ndarray, b: np.ndarray) -> float:
        return float(100 * np.linalg.norm(a - b, axis=1)[inner].mean() / ocular)

    flat = np.ones_like(true_light)
    return {
        "median": float(np.median(distance)),
        "mean": float(distance.mean()),
        "p95": float(np.percentile(distance, 95)),
        "mean_face_median": float(np.median(baseline)),
        "mean_face_mean": float(baseline.mean()),
        "ratio": float(np.median(distance) / np.median(baseline)),
        "albedo": relative_error(albedo, true_albedo, False),
        "albedo_channel": relative_error(albedo, true_albedo, True),
        "mean_albedo": relative_error(mean_albedo, true_albedo, False),
        "mean_albedo_channel": relative_error(mean_albedo, true_albedo, True),
        "light": relative_error(light, true_light, False),
        "light_channel": relative_error(light, true_light, True),
        "ambient_light": relative_error(flat, true_light, False),
        "ambient_light_channel": relative_error(flat, true_light, True),
        "landmarks_fit_to_detected": gap(estimate.landmarks, estimate.detected),
        "landmarks_detected_to_true": gap(estimate.detected, points),
        "landmarks_fit_to_true": gap(estimate.landmarks, points),
        "rotation": rotation_angle(estimate.rotation, truth["rotation"]),
        "identity_rms": float(np.sqrt(np.mean(estimate.identity**2))),
        "seconds": estimate.seconds,
    }


def sphere(size: int = 96) -> tuple[np.ndarray, np.ndarray]:
    """Normals (size, size, 3) of a ball seen from the front, and where it covers the picture."""
    grid = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(grid, -grid)
    inside = x**2 + y**2 < 1
    z = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    return np.stack([x, y, z], axis=-1), inside
