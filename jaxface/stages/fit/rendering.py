"""Render a fit: colour, normals and which skin is compared."""

import equinox as eqx
import jax.numpy as jnp

from jaxface._numerics import safe_norm
from jaxface._types import Array, Bool, Float
from jaxface.geometry.mesh import vertex_normals
from jaxface.geometry.rotation import rotation_matrix
from jaxface.imaging.masks import dilate, fill_polygon, smoothstep
from jaxface.imaging.resample import resize
from jaxface.models.landmark_schemes import CONTOURS
from jaxface.models.morphable import MorphableModel
from jaxface.models.parameters import FaceParameters
from jaxface.render._interpolate import interpolate
from jaxface.render._rasterize import Fragments, rasterize
from jaxface.render.occlusion import hidden_shading
from jaxface.render.shading import irradiance
from jaxface.stages.fit.inliers import inlier_weights
from jaxface.stages.fit.prepared import FitModel


class FitRender(eqx.Module):
    """What the fitted model looks like in the working image."""

    color: Float[Array, "s s 3"]
    """C_synth, linear RGB"""
    albedo: Float[Array, "s s 3"]
    normal: Float[Array, "s s 3"]
    """unit, camera frame; zero on the background"""
    fragments: Fragments
    skin: Bool[Array, "s s"]
    """pixels whose triangle the photo term compares"""


def render_fit(
    y: FaceParameters, model: FitModel, principal: Float[Array, "2"], size: int
) -> FitRender:
    """Render the fitted face at ``size`` x ``size`` pixels of the working image."""
    vertices = model.model.shape(y.identity, y.expression)
    rotation = rotation_matrix(y.rotation)
    screen = y.camera(principal, size).project(vertices @ rotation.T + y.translation)
    faces = model.model.faces
    fragments = rasterize(screen, faces, size, size, cull=True)
    hidden = fit_hidden_shading(y, model.model)
    per_vertex = jnp.concatenate(
        [vertex_normals(vertices, faces), model.model.reflectance(y.albedo), hidden], axis=1
    )
    at_pixel = interpolate(per_vertex, faces, fragments)
    normal = at_pixel[..., :3] @ rotation.T
    normal = normal / jnp.maximum(safe_norm(normal, keepdims=True), 1e-6)
    covered = fragments.triangle >= 0
    albedo, shading = at_pixel[..., 3:6], irradiance(normal, y.light) + at_pixel[..., 6:]
    color = jnp.where(covered[..., None], albedo * shading, 0.0)
    skin = covered & model.face_mask[jnp.maximum(fragments.triangle, 0)]
    return FitRender(color, albedo, normal, fragments, skin)


def fit_hidden_shading(y: FaceParameters, model: MorphableModel) -> Float[Array, "n 3"]:
    """Shading (negative) that the face's own parts take from each vertex under the fitted light."""
    if model.occlusion is None:
        return jnp.zeros((model.vertex_count, 3), y.light.dtype)
    normals = vertex_normals(model.shape(y.identity, y.expression), model.faces)
    return hidden_shading(model.occlusion_of(normals), rotation_matrix(y.rotation), y.light)


def skin_map(
    rendered: FitRender, image: Float[Array, "s s 3"], mask: Float[Array, "s s"]
) -> Float[Array, "s s"]:
    """Pixels that show skin as the fit explains it: mask, less hair, hands and glasses.

    The inlier weights of the fit, with wider limits so that folds and beard stay, on the rendered
    working image, averaged over 4x4 pixels and steepened, so that the map has smooth borders and
    no single-pixel holes.
    """
    size = image.shape[0]
    weight = (mask * rendered.skin).reshape(-1)
    inlier = inlier_weights(
        image.reshape(-1, 3), rendered.color.reshape(-1, 3), weight, accept=4.0, reject=6.0
    )
    valid = (mask * rendered.skin)[..., None]
    shares = resize(
        jnp.concatenate([inlier.reshape(size, size, 1) * valid, valid], axis=-1),
        size // 4,
        size // 4,
    )
    smooth = resize(shares, size, size)
    share = smooth[..., 0] / jnp.maximum(smooth[..., 1], 1e-6)
    return smoothstep(share, 0.35, 0.65) * mask * rendered.skin


def brow_map(landmarks: Float[Array, "468 2"], size: int) -> Bool[Array, "s s"]:
    """Pixels of the brows, which differ from the model's more than any skin, yet are of the face.

    Args:
        landmarks: of the face mesh, as fractions of the side.
        size: side, px.
    """
    points = landmarks * size
    lines = [points[jnp.asarray(CONTOURS[f"{side} brow"])] for side in ("left", "right")]
    filled = [fill_polygon(line, size, size) for line in lines]
    return dilate(filled[0] | filled[1], size / 50)
