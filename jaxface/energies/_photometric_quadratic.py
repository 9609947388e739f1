"""Gauss-Newton model of ``E_c`` from the structure of the renderer instead of autodiff.

At a pixel the colour is ``c = a * s`` with albedo ``a = sum_i b_i a_i``, shading
``s = L^T H(n)``, unit normal ``n = m/|m|``, ``m = sum_i b_i n_i``, and the barycentric weights
``b`` of the point where the pixel's ray meets its triangle. If the surface point moves by ``u``
with the weights held, the ray slides over the triangle by
``tau = X (g.u)/(g.X) - u`` (g the plane's normal, X the point), so

``dc = (s grad a + D grad m) tau + D sum_i b_i dn_i``,  ``D = a * L^T H'(n) (I - n n^T)/|m|``.

The shading hidden by the face itself, where the model knows it, is one more interpolated
per-vertex colour in ``s``, linear in the light, turned with the head, and where the model knows
that too linear in the vertex normals, to whose modes it adds ``a sum_i b_i dh_i/dn_i dn_i``.

Every geometric unknown enters by ``u`` and ``sum b_i dn_i`` alone: both are interpolated rows of
bases, and the camera's own motion is written down directly. Forward autodiff of the same
Jacobian carries the whole mesh through each of some 250 columns.
"""

import jax
import jax.numpy as jnp

from jaxface._numerics import cross, safe_norm, safe_sqrt
from jaxface._types import Array, Float
from jaxface.energies.photometric import (
    PhotometricData,
    PixelSamples,
    photometric_energy,
    reweighting,
)
from jaxface.energies.term import Quadratic
from jaxface.geometry.mesh import vertex_normals
from jaxface.geometry.normal_stencil import NormalStencil, normal_derivative
from jaxface.geometry.ray import pixel_rays, ray_weights
from jaxface.geometry.rotation import rotation_matrix
from jaxface.models.morphable import MorphableModel
from jaxface.models.parameters import FaceParameters
from jaxface.render.occlusion import hidden_shading, sh_rotation
from jaxface.render.shading import irradiance, irradiance_slope, sh_basis


def shape_basis(model: MorphableModel) -> Float[Array, "n 3 k"]:
    """Identity and expression modes side by side, in the order of ``FaceParameters``."""
    return jnp.concatenate([model.identity.basis, model.expression.basis], axis=-1)


def normal_modes(
    y: FaceParameters, model: MorphableModel, stencil: NormalStencil
) -> Float[Array, "n 3 k"]:
    """Derivative of the unit vertex normals (model frame) along every shape mode at ``y``."""
    vertices = model.shape(y.identity, y.expression)
    return normal_derivative(vertices, stencil, shape_basis(model))[1]


def _interpolate(weights, values, corners):
    """sum_i b_i values[corner i], corner by corner so that no (p, 3, ...) array is formed."""
    out = 0.0
    for corner in range(3):
        w = weights[:, corner].reshape(-1, *[1] * (values.ndim - 1))
        out = out + w * values[corners[:, corner]]
    return out


def photometric_jacobian(
    y: FaceParameters,
    model: MorphableModel,
    normal_modes: Float[Array, "n 3 k"],
    samples: PixelSamples,
) -> tuple[Float[Array, "p 3"], Float[Array, "p 3 q"]]:
    """``C_synth`` at the samples and its exact Jacobian in the flattened unknowns.

    Columns are ordered as ``jax.flatten_util.ravel_pytree`` orders ``FaceParameters``. Visibility
    is held fixed, as in ``synthesize``, whose forward-mode Jacobian this equals to rounding if
    ``normal_modes`` belong to the same shape.

    Args:
        y: the unknowns.
        model: the morphable model.
        normal_modes: derivative of the unit vertex normals along every mode (``normal_modes``).
        samples: the pixels.
    """
    basis = shape_basis(model)
    vertices = model.shape(y.identity, y.expression)
    tri = samples.triangle
    unit = vertex_normals(vertices, model.faces)
    reflectance = model.reflectance(y.albedo)

    rotation = rotation_matrix(y.rotation)
    rotation_change = jax.jacfwd(rotation_matrix)(y.rotation)  # (3, 3, 3): d R / d w_k
    points = vertices[tri] @ rotation.T + y.translation  # (p, 3 corners, 3)
    normals = unit[tri] @ rotation.T
    albedos = reflectance[tri]

    camera = y.camera(samples.principal)
    b = ray_weights(pixel_rays(samples.position, camera.focal, camera.principal), points)
    x = jnp.einsum("pi,pij->pj", b, points)
    m = jnp.einsum("pi,pij->pj", b, normals)
    a = jnp.einsum("pi,pij->pj", b, albedos)
    m_norm = jnp.maximum(safe_norm(m, keepdims=True), 1e-12)
    n = m / m_norm
    shading = irradiance(n, y.light)
    hidden, occlusion = None, None
    if model.occlusion is not None:
        occlusion = model.occlusion_of(unit)
        hidden = hidden_shading(occlusion, rotation, y.light)
        shading = shading + _interpolate(b, hidden, tri)

    # D: colour change for a change of the interpolated normal m.
    d = a[:, :, None] * irradiance_slope(n, y.light)
    d = (d - (d @ n[:, :, None]) * n[:, None, :]) / m_norm[:, :, None]

    # Gradients of the weights in the triangle's plane: tau -> db_i = beta_i . tau.
    edge1, edge2 = points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]
    g = cross(edge1, edge2)
    area2 = jnp.sum(g * g, axis=-1, keepdims=True)
    inverse = jnp.where(area2 > 0, 1.0 / jnp.where(area2 > 0, area2, 1.0), 0.0)
    beta1, beta2 = cross(edge2, g) * inverse, cross(g, edge1) * inverse

    def plane_gradient(corner_values):
        first = corner_values[:, 1] - corner_values[:, 0]
        second = corner_values[:, 2] - corner_values[:, 0]
        return first[:, :, None] * beta1[:, None, :] + second[:, :, None] * beta2[:, None, :]

    slope = shading[:, :, None] * plane_gradient(albedos) + d @ plane_gradient(normals)
    if hidden is not None:
        slope = slope + a[:, :, None] * plane_gradient(hidden[tri])
    g_dot_x = jnp.sum(g * x, axis=-1, keepdims=True)
    edge_on = g_dot_x == 0
    along = g / jnp.where(edge_on, 1.0, g_dot_x)
    slope = (slope @ x[:, :, None]) * along[:, None, :] - slope
    slope = jnp.where(edge_on[:, :, None], 0.0, slope)

    u_modes = _interpolate(b, basis, tri)
    n_modes = _interpolate(b, normal_modes, tri)
    j_shape = (slope @ rotation) @ u_modes + (d @ rotation) @ n_modes

    x_model = jnp.einsum("pi,pij->pj", b, vertices[tri])
    m_model = jnp.einsum("pi,pij->pj", b, unit[tri])
    u_rotation = jnp.einsum("ijk,pj->pik", rotation_change, x_model)
    n_rotation = jnp.einsum("ijk,pj->pik", rotation_change, m_model)
    j_rotation = slope @ u_rotation + d @ n_rotation
    u_focal = x * jnp.array([1.0, 1.0, 0.0], x.dtype)
    j_focal = slope @ u_focal[:, :, None]

    j_albedo = shading[:, :, None] * _interpolate(b, model.albedo.basis, tri)
    harmonics = sh_basis(n)
    if occlusion is not None:
        turn = sh_rotation(rotation)
        harmonics = harmonics + _interpolate(b, occlusion @ turn.T, tri)
        turned_light = jax.jacfwd(lambda w: sh_rotation(rotation_matrix(w)).T @ y.light)(y.rotation)
        unlit = _interpolate(b, occlusion, tri)
        j_rotation = j_rotation + a[:, :, None] * jnp.einsum("pk,kcw->pcw", unlit, turned_light)
    if occlusion is not None and model.occlusion_slope is not None:
        turning = jnp.swapaxes(hidden_shading(model.occlusion_slope, rotation, y.light), 1, 2)
        for corner in range(3):
            at = tri[:, corner]
            by_corner = (b[:, corner, None] * a)[:, :, None] * turning[at]
            j_shape = j_shape + by_corner @ normal_modes[at]
    eye = jnp.eye(3, dtype=n.dtype)
    j_light = jnp.einsum("pc,pj,cd->pcjd", a, harmonics, eye).reshape(*a.shape, 27)
    jacobian = jnp.concatenate([j_shape, j_albedo, j_light, j_rotation, slope, j_focal], axis=-1)
    return a * shading, jacobian


def photometric_quadratic(
    y: FaceParameters,
    data: PhotometricData,
    normal_modes: Float[Array, "n 3 k"],
    curvature_samples: PixelSamples | None = None,
) -> Quadratic:
    """Value, gradient and Gauss-Newton curvature of ``E_c``.

    The curvature is that of the IRLS majoriser (``reweighting``). The gradient is exact for all
    samples; with ``curvature_samples`` it comes from one reverse pass over them while the
    Jacobian is formed on that smaller, evenly spread list only. ``normal_modes`` may then come
    from a nearby shape: that changes the curvature slightly and the gradient not at all.
    """
    sampled = data.samples if curvature_samples is None else curvature_samples
    synth, jacobian = photometric_jacobian(y, data.model, normal_modes, sampled)
    used = sampled.weight[:, None] > 0
    difference = jnp.where(used, sampled.color - synth, 0.0)
    weight = reweighting(difference, sampled.weight)
    scaled = (safe_sqrt(weight)[:, None, None] * jacobian).reshape(-1, jacobian.shape[-1])
    scaled = jnp.where(jnp.repeat(used, 3, axis=0), scaled, 0.0)
    curvature = scaled.T @ scaled
    if curvature_samples is None:
        root = (safe_sqrt(weight)[:, None] * difference).reshape(-1)
        value = photometric_energy(y, data)
        return Quadratic(value, -2 * (root @ scaled), curvature)
    value, gradient = jax.value_and_grad(photometric_energy)(y, data)
    flat = jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(gradient)])
    return Quadratic(value, flat, curvature)
