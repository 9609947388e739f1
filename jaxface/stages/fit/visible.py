"""Which triangle each pixel of the working image shows, and the pixels that are compared."""

import jax

from jaxface._types import Array, Float, Int
from jaxface.energies.photometric import PixelSamples, sample_pixels
from jaxface.models.parameters import FaceParameters
from jaxface.render.rasterize import rasterize
from jaxface.stages.fit.prepared import FitModel
from jaxface.stages.fit.records import FitInput


def visible_triangles(
    y: FaceParameters, model: FitModel, principal: Float[Array, "2"], size: int
) -> Int[Array, "s s"]:
    """(s, s) index of the triangle each pixel shows, -1 for none; no gradient passes."""
    y = jax.lax.stop_gradient(y)
    vertices = y.pose(model.model.shape(y.identity, y.expression))
    screen = y.camera(principal, size).project(vertices)
    return rasterize(screen, model.model.faces, size, size, cull=True).triangle


def visible_samples(
    y: FaceParameters,
    image: Float[Array, "s s 3"],
    mask: Float[Array, "s s"],
    data: FitInput,
    model: FitModel,
) -> PixelSamples:
    """The pixels that show skin of the face at ``y``, half of the image's at most."""
    size = image.shape[0]
    triangle = visible_triangles(y, model, data.principal, size)
    return sample_pixels(
        image, mask, triangle, model.model.faces, model.face_mask, data.principal, size * size // 2
    )
