"""Which triangle each pixel of the working image shows, and the pixels that are compared."""

import jax

from jaxface._types import Array, Float, Int
from jaxface.energies.photometric import PixelSamples
from jaxface.models.parameters import FaceParameters
from jaxface.render._rasterize import rasterize
from jaxface.stages.fit.prepared import FitModel
from jaxface.stages.fit.records import FitInput
from jaxface.stages.fit.samples import sample_pixels


def visible_triangles(
    y: FaceParameters,
    model: FitModel,
    principal: Float[Array, "2"],
    side: float | Float[Array, ""],
    canvas: int,
) -> Int[Array, "s s"]:
    """(canvas, canvas) index of the triangle each pixel shows, -1 for none; no gradient passes.

    The working image, of ``side`` px, fills the canvas or a corner of it.
    """
    y = jax.lax.stop_gradient(y)
    vertices = y.pose(model.model.shape(y.identity, y.expression))
    screen = y.camera(principal, side).project(vertices)
    return rasterize(screen, model.model.faces, canvas, canvas, cull=True).triangle


def visible_samples(
    y: FaceParameters,
    image: Float[Array, "s s 3"],
    mask: Float[Array, "s s"],
    side: float | Float[Array, ""],
    data: FitInput,
    model: FitModel,
    capacity: int,
) -> PixelSamples:
    """The pixels that show skin of the face at ``y``, at most half of the canvas's and capacity.

    Args:
        y: the unknowns.
        image: canvas with the working image, linear RGB.
        mask: valid face pixels, 0 beyond the working image.
        side: of the working image, px.
        data: its camera.
        model: level of detail.
        capacity: of the list; more pixels are stood for by an evenly spread subset.
    """
    canvas = image.shape[0]
    triangle = visible_triangles(y, model, data.principal, side, canvas)
    return sample_pixels(
        image,
        mask,
        triangle,
        model.model.faces,
        model.face_mask,
        data.principal,
        min(capacity, canvas * canvas // 2),
        side,
    )
