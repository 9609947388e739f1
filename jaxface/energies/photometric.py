"""Photo-consistency ``E_c`` (Saito 2017, section 3) on a list of visible pixels.

``E_c = 1/|M| sum_p ||C_input(p) - C_synth(p)||_2`` over the visible face pixels M: the norm of
each pixel's colour difference is *not* squared, so that the energy resists outliers.
"""

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxface._numerics import safe_norm, safe_sqrt
from jaxface._types import Array, Float, Int
from jaxface.geometry.mesh import vertex_normals
from jaxface.geometry.ray import pixel_rays, ray_weights
from jaxface.geometry.rotation import rotation_matrix
from jaxface.models.morphable import MorphableModel
from jaxface.models.parameters import FaceParameters
from jaxface.render.occlusion import hidden_shading
from jaxface.render.shading import irradiance


class PixelSamples(eqx.Module):
    """Visible pixels of a photo with the triangle each of them shows (visibility held fixed)."""

    position: Float[Array, "p 2"]
    """pixel centres (x, y), as fractions of the working image's side"""
    triangle: Int[Array, "p 3"]
    """vertex indices of the visible triangle"""
    color: Float[Array, "p 3"]
    """C_input, linear RGB"""
    weight: Float[Array, "p"]
    """share of the pixel in the mean, in [0, 1]; 0 marks unused entries"""
    principal: Float[Array, "2"]
    """principal point of the camera, as fractions of the side"""


class PhotometricData(eqx.Module):
    """Arguments of the photometric energy."""

    model: MorphableModel
    samples: PixelSamples


def synthesize(
    y: FaceParameters, model: MorphableModel, samples: PixelSamples
) -> Float[Array, "p 3"]:
    """``C_synth``: Lambertian colour (linear RGB) that the model shows at each sample.

    Albedo and the area-weighted vertex normals are interpolated perspective-correctly and shaded
    by second-order spherical harmonics, less what the face itself hides of the light where the
    model has an ``occlusion`` (the paper's shading is that without).
    """
    vertices = model.shape(y.identity, y.expression)
    rotation = rotation_matrix(y.rotation)
    normals = vertex_normals(vertices, model.faces)
    used = samples.triangle
    corners = vertices[used] @ rotation.T + y.translation
    camera = y.camera(samples.principal)
    weights = ray_weights(pixel_rays(samples.position, camera.focal, camera.principal), corners)
    normal = jnp.einsum("pi,pij->pj", weights, normals[used]) @ rotation.T
    normal = normal / jnp.maximum(safe_norm(normal, keepdims=True), 1e-12)
    albedo = jnp.einsum("pi,pij->pj", weights, model.reflectance(y.albedo)[used])
    shading = irradiance(normal, y.light)
    if model.occlusion is not None:
        hidden = hidden_shading(model.occlusion_of(normals), rotation, y.light)
        shading = shading + jnp.einsum("pi,pij->pj", weights, hidden[used])
    return albedo * shading


def photometric_difference(y: FaceParameters, data: PhotometricData) -> Float[Array, "p 3"]:
    """``C_input(p) - C_synth(p)`` at each sample (linear RGB), zero at unused entries."""
    difference = data.samples.color - synthesize(y, data.model, data.samples)
    return jnp.where(data.samples.weight[:, None] > 0, difference, 0.0)


def photometric_energy(y: FaceParameters, data: PhotometricData) -> Float[Array, ""]:
    """``E_c``: weighted mean over the samples of the norm of the colour difference.

    The derivative of a pixel that matches exactly is taken as zero.
    """
    weight = data.samples.weight
    total = jnp.maximum(jnp.sum(weight), 1.0)
    return jnp.sum(weight * safe_norm(photometric_difference(y, data))) / total


def reweighting(
    difference: Float[Array, "p 3"], weight: Float[Array, "p"], floor: float = 1e-3
) -> Float[Array, "p"]:
    """IRLS weights: ``weight / (2 max(||d||, floor)) / sum(weight)``.

    With these, ``sum_p w_p ||d_p||^2`` has the gradient of ``E_c`` at the current point (and
    majorises it up to a constant), except where ``||d|| < floor`` (linear RGB), where the norm
    is replaced by a parabola. No gradient passes through the weights: they are a
    ``stop_gradient``.
    """
    norm = jax.lax.stop_gradient(safe_norm(difference))
    return weight / (2 * jnp.maximum(norm, floor)) / jnp.maximum(jnp.sum(weight), 1.0)


def photometric_residual(y: FaceParameters, data: PhotometricData) -> Float[Array, "p 3"]:
    """Residual whose squared norm is the IRLS majoriser of ``E_c`` at ``y``.

    ``||r||^2 = E_c / 2`` and ``grad ||r||^2 = grad E_c`` where no pixel is under the floor of
    ``reweighting``, whose weights are constants (``stop_gradient``). A sample of weight 0 has a
    zero row, with a zero derivative in the weight too (where that of a square root does not exist).
    """
    difference = photometric_difference(y, data)
    return safe_sqrt(reweighting(difference, data.samples.weight))[:, None] * difference


def photometric_root_residual(
    y: FaceParameters, data: PhotometricData, floor: float = 1e-3
) -> Float[Array, "p 3"]:
    """Residual whose squared norm is ``E_c`` itself, for least-squares solvers.

    ``r_p = sqrt(s_p / sum(s)) d_p / (||d_p||^2 + floor^2)^(1/4)``, so that ``||r||^2`` is ``E_c``
    and its gradient that of ``E_c``, but where ``||d_p||`` comes near to ``floor`` (linear RGB). No
    weight is held fixed: a solver that lowers it lowers ``E_c``. ``photometric_residual`` is
    the one that belongs to one step of reweighting.
    """
    weight = data.samples.weight
    share = weight / jnp.maximum(jnp.sum(weight), 1.0)
    difference = photometric_difference(y, data)
    square = jnp.sum(difference**2, axis=-1) + floor**2
    return (safe_sqrt(share) / square**0.25)[:, None] * difference
