"""Which triangle each pixel of the working image shows."""

import jax

from jaxface._types import Array, Float, Int
from jaxface.models.parameters import FaceParameters
from jaxface.render.rasterize import rasterize
from jaxface.stages.fit.prepared import FitModel


def visible_triangles(
    y: FaceParameters, model: FitModel, principal: Float[Array, "2"], size: int
) -> Int[Array, "s s"]:
    """(s, s) index of the triangle each pixel shows, -1 for none; no gradient passes."""
    y = jax.lax.stop_gradient(y)
    vertices = y.pose(model.model.shape(y.identity, y.expression))
    screen = y.camera(principal, size).project(vertices)
    return rasterize(screen, model.model.faces, size, size, cull=True).triangle
