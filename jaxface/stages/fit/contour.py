"""Landmarks of the outline, which slide over the mesh as the head turns."""

import equinox as eqx
import jax.numpy as jnp

from jaxface._numerics import safe_normalize
from jaxface._types import Array, Int
from jaxface.energies.landmark import LandmarkData
from jaxface.geometry.mesh import vertex_normals
from jaxface.geometry.rotation import rotation_matrix
from jaxface.imaging.masks import smoothstep
from jaxface.models.morphable import SurfacePoints
from jaxface.models.parameters import FaceParameters

GRAZING = (0.1, 0.5)
"""cosines of the angle to the view at which a landmark does not count, and counts fully"""


def slide_contour(
    y: FaceParameters,
    data: LandmarkData,
    contour: Int[Array, "k"],
    candidates: Int[Array, "c"],
    reach: float = 0.35,
) -> LandmarkData:
    """Keep to the landmarks that can be seen, and move hidden contour points to the silhouette.

    Where the surface turns away a detector guesses: landmarks off the contour lose their weight
    between the two cosines of ``GRAZING``. Contour points it places on the outline it sees, and
    once the head turns the outline is not where the frontal jaw was: a contour landmark whose
    own surface point faces away from the camera is attached to the candidate vertex on the
    silhouette that is nearest to its detected position, and loses its weight if none lies within
    ``reach`` units.

    Args:
        y: current estimate, held fixed (the choice is discrete; no gradient passes).
        data: the landmarks.
        contour: indices of the landmarks that may slide.
        candidates: vertices that may form the silhouette (face, jaw and neck skin).
        reach: greatest distance, in ``data.unit``, between a detection and its new point.
    """
    model = data.model
    vertices = model.shape(y.identity, y.expression)
    rotation = rotation_matrix(y.rotation)
    normals = vertex_normals(vertices, model.faces) @ rotation.T
    posed = vertices @ rotation.T + y.translation
    view = -safe_normalize(posed)
    facing = jnp.sum(normals * view, axis=-1)
    own_facing = data.points(facing[:, None])[:, 0]
    hidden = own_facing[contour] < 0.05

    screen = y.camera(data.principal).project(posed[candidates])[:, :2]
    target = data.target[contour]
    distance = jnp.linalg.norm(target[:, None] - screen[None], axis=-1) / data.unit
    on_silhouette = jnp.abs(facing[candidates]) < 0.25
    distance = jnp.where(on_silhouette[None], distance, jnp.inf)
    nearest = jnp.argmin(distance, axis=1)
    near = jnp.min(distance, axis=1) < reach
    at_contour = SurfacePoints(data.points.vertices[contour], data.points.weights[contour])
    slid = jnp.broadcast_to(candidates[nearest][:, None], at_contour.vertices.shape)
    moved = (hidden & near)[:, None]
    corner = jnp.array([1.0, 0.0, 0.0], model.mean.dtype)
    points = SurfacePoints(
        data.points.vertices.at[contour].set(jnp.where(moved, slid, at_contour.vertices)),
        data.points.weights.at[contour].set(jnp.where(moved, corner, at_contour.weights)),
    )
    seen = smoothstep(own_facing, *GRAZING)
    seen = seen.at[contour].set(jnp.where(hidden, jnp.where(near, 1.0, 0.0), 1.0))
    weight = data.weight * seen
    return eqx.tree_at(lambda d: (d.points, d.weight), data, (points, weight))
