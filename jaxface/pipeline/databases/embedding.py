"""Landmark correspondences of a new topology, found by rendering it and running the detector."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import distance_transform_edt

from jaxface._types import Bool, Float, Int
from jaxface.geometry.camera import Camera, Pose
from jaxface.geometry.rotation import rotation_matrix
from jaxface.imaging.colour import linear_to_srgb
from jaxface.io.face_models import load_model
from jaxface.io.face_models.model_file import save_model
from jaxface.io.formats.image import write_png
from jaxface.io.pictures.drawing import draw_landmarks
from jaxface.io.pictures.overlay import contact_sheet
from jaxface.models.landmark_schemes import MEDIAPIPE_TO_IBUG68, MEDIAPIPE_TO_IBUG68_WEIGHTS
from jaxface.models.morphable import MorphableModel, SurfacePoints
from jaxface.render.image import render
from jaxface.render.shading import ambient_light
from jaxface.stages.landmarks import detect_faces

_SIZE = 512
_DISTANCE = 900.0
_FOCAL = 1500.0
YAWS = (-30.0, -15.0, 0.0, 15.0, 30.0)
"""degrees; the model's mean is looked at from these sides"""

STEEPEST = 70.0
"""degrees between normal and view up to which a pixel tells where a point is"""

REACH = 10.0
"""px to the nearest such pixel up to which it does"""


class Embedding(NamedTuple):
    """Correspondences and how well the views agree on them.

    Attributes:
        points: the 468 points on the mesh.
        spread: (468,) root mean square distance (mm) of the views' points to their mean.
        views: number of views in which the face was found.
        pictures: the renders with the points found, for a look.
    """

    points: SurfacePoints
    spread: Float[np.ndarray, "468"]
    views: int
    pictures: list[np.ndarray]


def embed_landmarks(model: MorphableModel, yaws: Sequence[float] = YAWS) -> Embedding:
    """Find the 468 points of the face mesh on a model's mean face.

    The mean is rendered from several sides under a soft light from the front, the detector runs
    on each picture, and the pixels it names (or the nearest that show the outside of the surface
    from less than 70 degrees, within 10 px) are carried back through the rasteriser's triangle
    ids and barycentrics. The median over the views is dropped on the mesh at the nearest
    surface point.

    Raises:
        ValueError: the detector finds a face in fewer than two views.
    """
    light = ambient_light(0.55).at[2].set(0.35).at[1].set(0.15)
    centre = _face_centre(model)
    faces = np.asarray(model.faces)
    hits: list[np.ndarray] = []
    seen: list[np.ndarray] = []
    pictures = []
    albedo = jnp.clip(model.albedo_mean, 0.0, 1.0)
    draw = jax.jit(
        lambda pose: render(
            model.mean, albedo, model.faces, pose,
            Camera(jnp.asarray(_FOCAL), jnp.full((2,), _SIZE / 2.0)), light, _SIZE, _SIZE,
            background=jnp.full(3, 0.5),
        )
    )  # fmt: skip
    for yaw in yaws:
        turn = jnp.array([0.0, np.radians(yaw), 0.0])
        offset = -np.asarray(rotation_matrix(turn)) @ centre + np.array([0.0, 0.0, -_DISTANCE])
        image = draw(Pose(turn, jnp.asarray(offset, jnp.float32)))
        picture = np.clip(np.asarray(linear_to_srgb(image.color)), 0, 1).astype(np.float32)
        found = detect_faces(picture)
        if not found:
            pictures.append(picture)
            continue
        points = np.asarray(found[0].landmarks)[:, :2]
        pictures.append(draw_landmarks(picture, points))
        hit, valid = _surface_hits(points, image, np.asarray(model.mean), faces)
        hits.append(hit)
        seen.append(valid)
    if len(hits) < 2:
        raise ValueError(
            f"the detector finds a face in {len(hits)} of {len(yaws)} views of the model "
            f"{model.name!r}; give its albedo or its 68 landmark vertices instead"
        )
    places, valid = np.stack(hits), np.stack(seen)
    valid |= ~valid.any(axis=0)  # a point no view sees well is taken from all
    masked = np.where(valid[..., None], places, np.nan)
    middle = np.nanmedian(masked, axis=0)
    spread = np.sqrt(np.nanmean(np.sum((masked - middle) ** 2, axis=-1), axis=0))
    return Embedding(_nearest_points(model, middle), spread, len(hits), pictures)


def with_landmarks(model: MorphableModel, points: SurfacePoints) -> MorphableModel:
    """The model with 468 correspondences, and with the 68 blended from them if it has none."""
    model = eqx.tree_at(lambda m: m.landmarks468, model, points, is_leaf=lambda x: x is None)
    if model.landmarks68 is not None:
        return model
    places = np.asarray(points(model.mean))
    blended = np.einsum(
        "lpd,lp->ld", places[MEDIAPIPE_TO_IBUG68], np.asarray(MEDIAPIPE_TO_IBUG68_WEIGHTS)
    )
    embedded = _nearest_points(model, blended)
    return eqx.tree_at(lambda m: m.landmarks68, model, embedded, is_leaf=lambda x: x is None)


def embed_landmarks_of(source: str, out: str | os.PathLike[str]) -> dict[str, Any]:
    """Load a model, find its landmarks, and write ``model.npz`` and ``landmarks.png``.

    Raises:
        ValueError: as ``load_model`` and ``embed_landmarks``.
    """
    model = load_model(source)
    found = embed_landmarks(model)
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    save_model(folder / "model.npz", with_landmarks(model, found.points))
    panels = [(f"yaw {yaw:.0f}", p) for yaw, p in zip(YAWS, found.pictures, strict=True)]
    sheet = contact_sheet(panels, columns=len(panels), cell=420, heading=model.name)
    write_png(folder / "landmarks.png", sheet)
    return {"views": found.views, "median_spread_mm": float(np.median(found.spread))}


def _face_centre(model: MorphableModel) -> Float[np.ndarray, "3"]:
    mean = np.asarray(model.mean)
    if model.landmarks68 is not None:
        return np.asarray(model.landmarks68(model.mean)).mean(axis=0)
    front = mean[mean[:, 2] > np.quantile(mean[:, 2], 0.7)]
    return front.mean(axis=0)


def _surface_hits(
    points: np.ndarray, image: Any, vertices: np.ndarray, faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "l 3"], Bool[np.ndarray, "l"]]:
    """Model-frame surface point under each image point, and whether it is to be trusted.

    Taken from the nearest pixel that shows the outside of the surface: through the openings of eyes
    and mouth, where a model has no eyeballs and no teeth, a pixel shows the inside of the head.
    """
    triangle = np.asarray(image.fragments.triangle)
    outside = (triangle >= 0) & (np.asarray(image.normals)[..., 2] > np.cos(np.radians(STEEPEST)))
    away = np.asarray(distance_transform_edt(~outside))
    rows, columns = np.asarray(
        distance_transform_edt(~outside, return_distances=False, return_indices=True)
    )
    column, row = np.clip(points.astype(int), 0, np.array(triangle.shape[::-1]) - 1).T
    far = away[row, column]
    row, column = rows[row, column], columns[row, column]
    corners = vertices[faces[triangle[row, column]]]
    weights = np.asarray(image.fragments.barycentric)[row, column]
    return np.einsum("li,lij->lj", weights, corners), far <= REACH


def _nearest_points(model: MorphableModel, places: Float[np.ndarray, "l 3"]) -> SurfacePoints:
    """Surface points of the mean nearest to places that lie on or near it."""
    vertices, faces = np.asarray(model.mean), np.asarray(model.faces)
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    chosen, weights = np.zeros(len(places), int), np.zeros((len(places), 3))
    middle = (a + b + c) / 3
    for index, place in enumerate(places):
        near = np.argsort(np.sum((middle - place) ** 2, axis=1))[:64]
        w = _closest_weights(place, a[near], b[near], c[near])
        at = w[:, :1] * a[near] + w[:, 1:2] * b[near] + w[:, 2:] * c[near]
        best = int(np.argmin(np.sum((at - place) ** 2, axis=1)))
        chosen[index], weights[index] = near[best], w[best]
    return SurfacePoints(jnp.asarray(faces[chosen], jnp.int32), jnp.asarray(weights, jnp.float32))


def _closest_weights(
    p: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray
) -> Float[np.ndarray, "f 3"]:
    """Weights of the point of each triangle nearest to p: its plane's foot, else an edge's."""
    e1, e2, d = b - a, c - a, p - a
    g11, g12, g22 = (np.sum(u * v, axis=1) for u, v in ((e1, e1), (e1, e2), (e2, e2)))
    r1, r2 = np.sum(e1 * d, axis=1), np.sum(e2 * d, axis=1)
    det = np.maximum(g11 * g22 - g12 * g12, 1e-12)
    w1, w2 = (g22 * r1 - g12 * r2) / det, (g11 * r2 - g12 * r1) / det
    inside = np.stack([1 - w1 - w2, w1, w2], axis=1)
    within = np.all(inside >= 0, axis=1, keepdims=True)
    candidates = [np.where(within, inside, np.nan)]
    for start, end, i, j in ((a, b, 0, 1), (b, c, 1, 2), (c, a, 2, 0)):
        edge = end - start
        t = np.sum((p - start) * edge, axis=1) / np.maximum(np.sum(edge * edge, axis=1), 1e-12)
        w = np.zeros((len(a), 3))
        w[:, j] = np.clip(t, 0, 1)
        w[:, i] = 1 - w[:, j]
        candidates.append(w)
    stack = np.stack(candidates)
    foot = stack[..., :1] * a + stack[..., 1:2] * b + stack[..., 2:] * c
    distance = np.sum((foot - p) ** 2, axis=-1)
    best = np.nanargmin(np.where(np.isnan(distance), np.inf, distance), axis=0)
    return stack[best, np.arange(len(a))]
