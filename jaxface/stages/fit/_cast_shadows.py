"""Hard shadows: light as an environment of non-negative radiance, and what the face hides of it.

Nine harmonics hold no lamp, so the self-occlusion of ``render.occlusion`` makes every shadow soft.
Between the pyramid's levels the light is therefore estimated once more, as non-negative radiance
from many directions, each with the shadow that the present shape casts in it (Sato, Sato & Ikeuchi,
"Illumination from shadows", IEEE TPAMI 2003). What that light loses in the shadows replaces the
transfer of self-occlusion; the fit itself goes on with its nine harmonics. With the transfer comes
its slope in the normals: what lies in shadow does not get brighter by turning to the light.
"""

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxface._numerics import safe_norm
from jaxface._types import Array, Float
from jaxface.energies.photometric import PixelSamples, reweighting
from jaxface.geometry.mesh import smooth_over_mesh, vertex_normals
from jaxface.geometry.ray import pixel_rays, ray_weights
from jaxface.geometry.rotation import rotation_matrix
from jaxface.imaging.masks import smoothstep
from jaxface.models.morphable import MorphableModel
from jaxface.models.parameters import FaceParameters
from jaxface.render.occlusion import (
    hidden_directions,
    hidden_shading,
    sh_rotation,
    sphere_lattice,
)
from jaxface.render.shading import irradiance, sh_basis
from jaxface.solvers.nonnegative import nonnegative_least_squares
from jaxface.stages.fit.prepared import FitModel
from jaxface.stages.fit.records import FitInput
from jaxface.stages.fit.visible import visible_samples

SHADOWED = (0.1, 0.35)
"""share of the light that is hidden up to which a pixel counts fully, and from which not at all"""

BEHIND = -0.5
"""cosine to the camera below which light reaches next to nothing of what a photo shows"""

SMOOTHING = 4
"""rounds of averaging over neighbours: a shadow's edge is known no better than some millimetres"""

RIDGE = 1e-3
"""of the radiance, in mean diagonal elements: holds directions that light nothing at zero"""


def cast_shadows(
    y: FaceParameters,
    image: Float[Array, "s s 3"],
    mask: Float[Array, "s s"],
    data: FitInput,
    model: FitModel,
    occluder: MorphableModel,
    *,
    directions: int = 256,
    pixels: int = 3000,
    rounds: int = 4,
    hold_light: bool = False,
) -> tuple[FaceParameters, Float[Array, "n 9"], Float[Array, "n 3 9"]]:
    """The light estimated anew with hard shadows: ``y`` with it, the transfer, and its slope.

    Over the visible face pixels p with albedo a, radiance ``E_j >= 0`` of the directions ``w_j`` of
    a lattice minimises the unsquared norm of the colour difference,

    ``sum_p || C_input(p) - a_p (4 / m) sum_j v_pj max(n_p . w_j, 0) E_j ||_2``,

    where v tells whether the present shape leaves ``w_j`` visible; by iteratively reweighted
    non-negative least squares. With the shading ``h_i = -(4 / m) sum_j (1 - v_ij) max(n_i . w_j, 0)
    E_j`` that a vertex loses, the nine coefficients ``L`` are found again by linear least squares,
    and the transfer ``o`` of self-occlusion becomes the nearest one with ``o_i L = h_i``: it
    follows light and head in the steps to come, as the soft one does. Its slope O in the normal is
    likewise the nearest one with ``O_i L = dh_i/dn_i = -(4 / m) sum_j (1 - v_ij) w_j E_j`` over the
    directions before the tangent plane, less what is along ``n_i``.

    No gradient passes.

    Args:
        y: the fit so far.
        image: working image of a level, linear RGB.
        mask: valid face pixels.
        data: the fit's input.
        model: level of detail; what it has as ``occlusion`` is the start.
        occluder: the model whose surface casts the shadows; the coarsest level of detail will do.
        directions: m, over the whole sphere; those that come from far behind the face are left out.
        pixels: number of pixels (evenly spread) that are compared.
        rounds: of reweighting.
        hold_light: whether the nine coefficients stay those of ``y``.

    Raises:
        ValueError: the model has no ``occlusion``.
    """
    soft = model.model.occlusion
    if soft is None:
        raise ValueError(f"model {model.model.name!r} has no occlusion; see render.occlusion")
    y = jax.lax.stop_gradient(y)
    face = model.model
    rotation = rotation_matrix(y.rotation)
    shape = face.shape(y.identity, y.expression)
    turned = shape @ rotation.T
    normals = vertex_normals(turned, face.faces)
    towards = sphere_lattice(directions)
    towards = towards[towards[:, 2] > BEHIND]
    lattice = jnp.asarray(towards, shape.dtype)
    casting = occluder.shape(y.identity, y.expression) @ rotation.T
    hidden = hidden_directions(turned, normals, casting, occluder.faces, towards)
    samples = visible_samples(y, image, mask, len(image), data, model, pixels)
    camera = y.camera(samples.principal)
    rays = pixel_rays(samples.position, camera.focal, camera.principal)
    share = ray_weights(rays, turned[samples.triangle] + y.translation)

    def at_pixels(values: Array) -> Array:
        a, b, c = (share[:, i, None] * values[samples.triangle[:, i]] for i in range(3))
        return a + b + c

    normal = at_pixels(normals)
    normal = normal / jnp.maximum(safe_norm(normal, keepdims=True), 1e-12)
    albedo = at_pixels(face.reflectance(y.albedo))
    cosine = (4.0 / directions) * jnp.maximum(normal @ lattice.T, 0.0)
    lit = cosine * (1.0 - at_pixels(hidden.astype(shape.dtype)))

    def reweighted(radiance: Array, _: None) -> tuple[Array, None]:
        weight = _weights(samples, albedo * (lit @ radiance))
        scaled = weight[:, None] * albedo**2
        gram = jnp.stack([(lit * row[:, None]).T @ lit for row in scaled.T])
        moment = jnp.einsum("pc,pj->cj", weight[:, None] * albedo * samples.color, lit)
        ridge = RIDGE * jnp.trace(gram, axis1=1, axis2=2)[:, None, None] / len(towards)
        gram = gram + ridge * jnp.eye(len(towards), dtype=gram.dtype)
        return jax.vmap(nonnegative_least_squares)(gram, moment).value.T, None

    start = jnp.ones((len(towards), 3), shape.dtype)
    radiance, _ = jax.lax.scan(reweighted, start, None, length=rounds)

    taken = (hidden & (normals @ lattice.T > 0)).astype(shape.dtype)
    moments = (lattice[:, :, None] * radiance[:, None, :]).reshape(-1, 9)
    bare = -(4.0 / directions) * (taken @ moments).reshape(-1, 3, 3)
    both = jnp.concatenate([jnp.sum(normals[:, :, None] * bare, 1), bare.reshape(-1, 9)], axis=1)
    # Each smoothed for itself: vectors of neighbours that face elsewhere would give light.
    both = smooth_over_mesh(both, face.faces, SMOOTHING)
    loss, turning = both[:, :3], both[:, 3:].reshape(-1, 3, 3)
    along = jnp.sum(normals[:, :, None] * turning, axis=1, keepdims=True)
    turning = rotation.T @ (turning - normals[:, :, None] * along)
    light = y.light
    if not hold_light:
        synth = albedo * (lit @ radiance)
        light = _harmonics(light, samples, normal, albedo, at_pixels(loss), synth)
    turned_light = sh_rotation(rotation).T @ light
    square = turned_light.T @ turned_light
    square = square + (1e-4 * jnp.trace(square) + 1e-9) * jnp.eye(3, dtype=square.dtype)
    back = jnp.linalg.solve(square, turned_light.T)
    transfer = soft + (loss - soft @ turned_light) @ back
    y = eqx.tree_at(lambda p: p.light, y, light)
    return jax.lax.stop_gradient((y, transfer, turning @ back))


def shadow_trust(
    y: FaceParameters, model: MorphableModel, samples: PixelSamples
) -> Float[Array, "p"]:
    """How far the shading of each pixel is known, 0 to 1: less the more of it lies in shadow.

    What a shadow leaves depends on the very shape that is sought, which the fit holds fixed in a
    step: an error of the shadow would be explained by the shape, and confirm itself. Pixels lose
    their weight as the share of the light that the face hides from them goes from the one to the
    other number of ``SHADOWED``. All count fully on a model without ``occlusion``.

    Args:
        y: the fit so far, held fixed.
        model: its ``occlusion`` tells what is hidden.
        samples: the pixels.
    """
    if model.occlusion is None:
        return jnp.ones_like(samples.weight)
    rotation = rotation_matrix(y.rotation)
    normals = vertex_normals(model.shape(y.identity, y.expression), model.faces)
    lost = -jnp.mean(hidden_shading(model.occlusion_of(normals), rotation, y.light), axis=-1)
    whole = jnp.mean(irradiance(normals @ rotation.T, y.light), axis=-1)
    share = jnp.maximum(lost, 0.0) / jnp.maximum(whole, 1e-3)
    return 1.0 - smoothstep(jnp.mean(share[samples.triangle], axis=-1), *SHADOWED)


def _weights(samples: PixelSamples, synth: Array) -> Array:
    return reweighting(samples.color - synth, samples.weight, floor=1e-2)


def _harmonics(
    light: Array, samples: PixelSamples, normal: Array, albedo: Array, loss: Array, synth: Array
) -> Float[Array, "9 3"]:
    """Nine coefficients for what the pixels show beside the light lost in shadows."""
    weight = _weights(samples, synth)
    columns = sh_basis(normal)
    gram = jnp.einsum("p,pc,pi,pj->cij", weight, albedo**2, columns, columns)
    shown = albedo * (samples.color - albedo * loss)
    moment = jnp.einsum("p,pc,pi->ci", weight, shown, columns)
    # What the face does not show of the sphere stays as it was.
    ridge = (1e-3 * gram[:, :1, :1] + 1e-9) * jnp.eye(9, dtype=gram.dtype)
    moment = moment + jnp.einsum("cij,jc->ci", ridge, light)
    return jnp.linalg.solve(gram + ridge, moment[..., None])[..., 0].T
