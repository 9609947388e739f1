"""Landmark term ``E_lan`` (Saito 2017, section 3), over points of the mesh.

``E_lan = 1/|F| sum_i ||f_i - Pi_P(R V_i + t)||_2^2``. The paper leaves the unit of the distance
open; here it is the distance between the outer eye corners in the photo (``unit``), so that the
term means the same at every resolution and pyramid level.
"""

import equinox as eqx
import jax.numpy as jnp

from jaxface._numerics import safe_sqrt
from jaxface._types import Array, Float
from jaxface.geometry.rotation import rotation_matrix
from jaxface.models.morphable import MorphableModel, SurfacePoints
from jaxface.models.parameters import FaceParameters


class LandmarkData(eqx.Module):
    """Arguments of the landmark energy."""

    model: MorphableModel
    points: SurfacePoints
    """where each landmark lies on the mesh"""
    target: Float[Array, "l 2"]
    """detected positions f_i (x, y), as fractions of the working image's side"""
    weight: Float[Array, "l"]
    """share of each landmark in the mean"""
    principal: Float[Array, "2"]
    """principal point of the camera, as fractions of the side"""
    unit: Float[Array, ""]
    """length that counts as 1, as a fraction of the side"""


def landmark_difference(y: FaceParameters, data: LandmarkData) -> Float[Array, "l 2"]:
    """``Pi_P(R V_i + t) - f_i`` in fractions of the working image's side.

    Only the vertices that carry landmarks are evaluated.
    """
    used, model = data.points.vertices, data.model
    corners = (
        model.mean[used]
        + model.identity.basis[used] @ y.identity
        + model.expression.basis[used] @ y.expression
    )
    points = jnp.einsum("li,lij->lj", data.points.weights, corners)
    posed = points @ rotation_matrix(y.rotation).T + y.translation
    return y.camera(data.principal).project(posed)[:, :2] - data.target


def landmark_residual(y: FaceParameters, data: LandmarkData) -> Float[Array, "l 2"]:
    """Residual with ``||r||^2 = E_lan``, the weighted mean of squared distances in ``unit``.

    A landmark of weight 0 takes no part: its row is zero, and so is the row's derivative in the
    weight (that of a square root, which does not exist there).
    """
    share = data.weight / jnp.maximum(jnp.sum(data.weight), 1e-6)
    return safe_sqrt(share)[:, None] * landmark_difference(y, data) / data.unit
