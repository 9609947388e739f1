"""Landmark correspondences found by looking: render, detect, intersect, average, symmetrise.

The fit compares detected points with points of the model, so the model's points are defined as
the detector's own answer on renders of the model: any habit of the detector cancels.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import KDTree

from jaxface.geometry.camera import Camera, Pose
from jaxface.geometry.closest_point import TriangleTree
from jaxface.geometry.rotation import axis_angle
from jaxface.geometry.subdivision import catmull_clark
from jaxface.imaging.colour import linear_to_srgb
from jaxface.models.landmark_schemes import LIPS_INNER
from jaxface.models.morphable import MorphableModel, SurfacePoints
from jaxface.models.subdivide import subdivide
from jaxface.render.image import render
from jaxface.render.shading import ambient_light, light_from_radiance, sh_basis
from jaxface.stages.landmarks import bundled_networks, detect_faces

SIZE = 640
FIELD_OF_VIEW = 24.0
DISTANCE = 760.0  # mm
HEIGHT = 10.0  # mm: the pupils above the middle of the picture
VIEWS = tuple((yaw, pitch) for yaw in (-32, -16, 0, 16, 32) for pitch in (-10, 6))
LIGHTS = (((0.0, 0.3, 1.0), 0.6), ((0.6, 0.4, 0.8), 0.4), ((-0.5, 0.6, 0.7), 0.4))
REFERENCE_JAW = 0.5  # activation of jawOpen
OPEN_JAW = (0.12, 0.5)  # its range on the faces with an open mouth
HUBER = 1.5  # mm
REACH = 9.0  # px: a point off the skin (inner lid, silhouette) takes the nearest skin pixel
HIDDEN = ("eyes", "mouth_interior", "ears")


@dataclass(frozen=True)
class Observations:
    """Detections laid on the control mesh of the reference shape: where and how sure."""

    points: np.ndarray  # (d, 468, 3) mm, zero where unseen
    weights: np.ndarray  # (d, 468), zero where unseen
    towards: np.ndarray  # (d, 3) unit direction to the camera, in the model's frame
    opened: np.ndarray  # (d,) True where the mouth is open


def reference_shape(model: MorphableModel) -> np.ndarray:
    """The mean with its mouth half open (n, 3), so that upper and lower lip lie apart."""
    return np.asarray(model.mean + model.expression(_jaw(model, REFERENCE_JAW)))


def _jaw(model: MorphableModel, activation: float) -> jax.Array:
    index = model.expression_names.index("jawOpen")
    z = jnp.zeros(model.expression.count)
    return z.at[index].set(activation / model.expression.std[index])


def observe(
    model: MorphableModel, identities: np.ndarray, albedos: np.ndarray, seed: int
) -> Observations:
    """Detect the 468 points on renders of sampled faces and carry them to the reference shape.

    Every other face opens its mouth, for a closed one does not show which lip a point is on.

    Args:
        model: the control mesh; its landmarks are not used.
        identities: (s, i) coefficients of the faces to render.
        albedos: (s, a) likewise.
        seed: of the lights, jaws and small head turns that are added to the views.
    """
    rng = np.random.default_rng(seed)
    fine = subdivide(model, 1)
    refinement = catmull_clark(np.asarray(model.quads), model.vertex_count)
    # A point of the refined mesh is carried to the control mesh at the same parameters.
    control = refinement.linear @ reference_shape(model)
    faces = np.asarray(fine.faces)
    hidden = np.asarray(fine.region_mask(*HIDDEN))[faces].any(axis=1)
    nets = bundled_networks()
    camera = Camera.from_field_of_view(FIELD_OF_VIEW, SIZE, SIZE)
    draw = jax.jit(
        lambda vertices, albedo, pose, light: render(
            vertices, albedo, fine.faces, pose, camera, light, SIZE, SIZE, background=0.25
        )
    )
    points, weights, towards, opened = [], [], [], []
    for k, (identity, albedo) in enumerate(zip(identities, albedos, strict=True)):
        jaw = rng.uniform(*OPEN_JAW) * (k % 2)
        vertices = fine.shape(jnp.asarray(identity), _jaw(fine, jaw))
        colours = jnp.clip(fine.reflectance(jnp.asarray(albedo)), 0.0, 1.0)
        direction, ambient = LIGHTS[rng.integers(len(LIGHTS))]
        light = _light(direction, ambient) * 0.6 / float(colours.mean()) ** 0.5
        for yaw, pitch in VIEWS:
            turn = _turn(yaw + rng.normal(0, 3), pitch + rng.normal(0, 3), rng.normal(0, 4))
            image = draw(vertices, colours, _pose(turn), light)
            picture = np.asarray(linear_to_srgb(jnp.clip(image.color, 0, 1)))
            found = detect_faces((255 * picture).round().astype(np.uint8), networks=nets)
            if len(found) == 1:
                at, sure = _carry(found[0].landmarks[:, :2], image, faces, hidden, control)
                points.append(at)
                weights.append(sure)
                towards.append(turn[2])
                opened.append(jaw > 0)
    return Observations(*(np.stack(x) for x in (points, weights, towards, opened)))


def _carry(pixels, image, faces, hidden, control) -> tuple[np.ndarray, np.ndarray]:
    triangle = np.asarray(image.fragments.triangle)
    skin = np.logical_and(triangle >= 0, ~hidden[triangle])
    away = np.asarray(distance_transform_edt(~skin))
    rows, columns = np.asarray(
        distance_transform_edt(~skin, return_distances=False, return_indices=True)
    )
    column, row = np.clip(pixels.astype(int), 0, SIZE - 1).T
    far = away[row, column]
    row, column = rows[row, column], columns[row, column]
    corner = control[faces[triangle[row, column]]]
    weight = np.asarray(image.fragments.barycentric)[row, column]
    points = np.einsum("li,lic->lc", weight, corner)
    facing = np.asarray(image.normals)[row, column, 2].clip(0, 1)
    sure = np.where(far <= REACH, facing, 0.0) / (1 + far)
    return points * (sure[:, None] > 0), sure


def consensus(
    seen: Observations,
    mirror: np.ndarray,
    vertices: np.ndarray,
    normals: np.ndarray,
    rounds: int = 12,
) -> tuple[np.ndarray, float]:
    """Robust, left-right symmetric mean position (468, 3), and the median distance to it (mm).

    A detector also answers for points that a view hides, so an observation counts only as far as
    the surface at the present estimate faces that camera; the first estimate is from views near
    the front. Distances beyond HUBER are down-weighted.

    Args:
        seen: the observations.
        mirror: index of each point's mirror image.
        vertices: of the reference shape (n, 3).
        normals: of the reference shape (n, 3).
        rounds: of re-weighting.

    Raises:
        ValueError: a point and its mirror image were never seen.
    """
    flip = np.array([-1, 1, 1])
    certain = seen.weights.copy()
    certain[np.ix_(~seen.opened, np.isin(np.arange(468), LIPS_INNER))] = 0
    points = np.concatenate([seen.points, seen.points[:, mirror] * flip])
    base = np.concatenate([certain, certain[:, mirror]])
    towards = np.concatenate([seen.towards, seen.towards * flip])
    if (base.sum(0) == 0).any():
        raise ValueError(f"points never seen: {np.flatnonzero(base.sum(0) == 0).tolist()}")
    nearest = KDTree(vertices)
    weights = base * (towards[:, 2:].clip(0) ** 16)
    mean, distance = points[0], np.zeros(base.shape)
    for _ in range(rounds):
        mean = np.einsum("dl,dlc->lc", weights, points) / weights.sum(0)[:, None]
        mean = (mean + mean[mirror] * flip) / 2
        normal = normals[nearest.query(mean, k=6)[1]].mean(1)
        facing = (towards @ normal.T).clip(0.02) ** 3
        distance = np.linalg.norm(points - mean, axis=2)
        weights = base * facing * np.minimum(1, HUBER / np.maximum(distance, 1e-6))
    counted = weights > 0.1 * weights.max(0)
    return mean, float(np.median(distance[counted]))


def attach(points: np.ndarray, vertices: np.ndarray, triangles: np.ndarray) -> SurfacePoints:
    """The nearest points of a surface (here: skin triangles) as barycentric points."""
    found = TriangleTree(vertices, triangles)(points, candidates=64)
    return SurfacePoints(jnp.asarray(triangles[found.triangle]), jnp.asarray(found.weights))


def _light(direction: tuple[float, float, float], ambient: float) -> jax.Array:
    """A directional lamp and an even surround, as shading coefficients."""
    towards = jnp.asarray(direction) / jnp.linalg.norm(jnp.asarray(direction))
    lamp = light_from_radiance(jnp.pi * jnp.outer(sh_basis(towards), jnp.ones(3)))
    return ambient_light(ambient) + (1 - ambient) * lamp / jnp.pi * 2


def _turn(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """Rotation matrix of Euler angles (degrees), about y, then x, then z."""
    y, x, z = np.radians([yaw, pitch, roll])
    about_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
    about_z = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
    return about_z @ about_x @ about_y


def _pose(turn: np.ndarray) -> Pose:
    """A turned head in front of the camera."""
    return Pose(axis_angle(jnp.asarray(turn, jnp.float32)), jnp.array([0.0, HEIGHT, -DISTANCE]))
