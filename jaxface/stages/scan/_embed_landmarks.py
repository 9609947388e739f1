"""Landmark correspondences of a new topology, found by rendering it and running the detector."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import distance_transform_edt

from jaxface._types import Bool, Float, Int
from jaxface.geometry.camera import Camera, Pose
from jaxface.geometry.closest_point import TriangleTree
from jaxface.geometry.rotation import rotation_matrix
from jaxface.imaging.colour import linear_to_srgb
from jaxface.models.landmark_schemes import MEDIAPIPE_TO_IBUG68, MEDIAPIPE_TO_IBUG68_WEIGHTS
from jaxface.models.morphable import MorphableModel, SurfacePoints
from jaxface.render.image import render
from jaxface.render.shading import ambient_light

_SIZE = 512
_DISTANCE = 900.0
_FOCAL = 1500.0
YAWS = (-30.0, -15.0, 0.0, 15.0, 30.0)
"""degrees; the model's mean is looked at from these sides"""

STEEPEST = 70.0
"""degrees between normal and view up to which a pixel tells where a point is"""

REACH = 10.0
"""px to the nearest such pixel up to which it does"""


class FoundFace(Protocol):
    """A face as a detector finds it."""

    @property
    def landmarks(self) -> Float[np.ndarray, "468 d"]:
        """Pixels (x, y, ...) in the picture."""
        ...


Detector = Callable[[Float[np.ndarray, "h w 3"]], Sequence[FoundFace]]
"""the faces of an sRGB-encoded picture, the foremost first; none where there is none"""


class Look(NamedTuple):
    """One side from which the mean face was looked at.

    Attributes:
        yaw: degrees.
        picture: sRGB-encoded render.
        landmarks: (468, 2) pixels where the detector found the points; None where no face.
    """

    yaw: float
    picture: Float[np.ndarray, "h w 3"]
    landmarks: Float[np.ndarray, "468 2"] | None


class Embedding(NamedTuple):
    """Correspondences and how well the views agree on them.

    Attributes:
        points: the 468 points on the mesh.
        spread: (468,) root mean square distance (mm) of the views' points to their mean.
        looks: the views that were tried.
    """

    points: SurfacePoints
    spread: Float[np.ndarray, "468"]
    looks: tuple[Look, ...]

    @property
    def views(self) -> int:
        """Number of views in which the face was found."""
        return sum(look.landmarks is not None for look in self.looks)


def embed_landmarks(
    model: MorphableModel, detect: Detector, yaws: Sequence[float] = YAWS
) -> Embedding:
    """Find the 468 points of the face mesh on a model's mean face.

    The mean is rendered from several sides under a soft light from the front, the detector runs
    on each picture, and the pixels it names (or the nearest that show the outside of the surface
    from less than 70 degrees, within 10 px) are carried back through the rasteriser's triangle
    ids and barycentrics. The median over the views is dropped on the mesh at the nearest
    surface point.

    Args:
        model: any, upright; its landmarks are not needed.
        detect: finds faces, as `jaxface.stages.detect_faces` does.
        yaws: degrees, of the views.

    Raises:
        ValueError: the detector finds a face in fewer than two views.
    """
    light = ambient_light(0.55).at[2].set(0.35).at[1].set(0.15)
    centre = _face_centre(model)
    faces = np.asarray(model.faces)
    hits: list[np.ndarray] = []
    seen: list[np.ndarray] = []
    looks: list[Look] = []
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
        found = detect(picture)
        points = np.asarray(found[0].landmarks)[:, :2] if found else None
        looks.append(Look(yaw, picture, points))
        if points is None:
            continue
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
    return Embedding(_nearest_points(model, middle), spread, tuple(looks))


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
    faces = np.asarray(model.faces)
    found = TriangleTree(np.asarray(model.mean), faces)(places, candidates=64)
    corners = jnp.asarray(faces[found.triangle], jnp.int32)
    return SurfacePoints(corners, jnp.asarray(found.weights, jnp.float32))
