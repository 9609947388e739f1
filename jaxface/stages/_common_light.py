"""One light for many fits of photos that were taken under the same (Saito 2017, section 6).

Fitted alone, a photo leaves open how much of a tint is the light's and how much the skin's. Over
many faces the light is what they have in common. With shapes and poses held, the image formation

    C_ip = g_i (mean_p + B_p alpha_i) * (H_ip L)

is linear in each of the light L, the exposure gains g_i and the albedo coefficients alpha_i while
the other two are held, so all three are found in closed form by turns, reweighted robustly.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxface._numerics import safe_norm, safe_normalize
from jaxface._types import Array, Bool, Float
from jaxface.geometry.mesh import vertex_normals
from jaxface.geometry.rotation import rotation_matrix
from jaxface.imaging.masks import smoothstep
from jaxface.imaging.resample import bilinear
from jaxface.models.morphable import MorphableModel
from jaxface.models.parameters import FaceParameters
from jaxface.render._depth_buffer import depth_buffer
from jaxface.render.occlusion import sh_rotation
from jaxface.render.shading import Y0, sh_basis

WORST_MISFIT = 1.5
"""misfit under the common light, over that under its own, from which a photo keeps its own"""


class LitVertices(eqx.Module):
    """What one photo shows at the vertices of a model."""

    colour: Float[Array, "n 3"]
    """linear RGB"""
    harmonics: Float[Array, "n 9"]
    """``H(n)`` less what the face hides from itself, camera frame"""
    weight: Float[Array, "n"]


class CommonLight(eqx.Module):
    """The light that all photos share, and what remains each one's own."""

    light: Float[Array, "9 3"]
    """shading coefficients for a gain of 1, which is the geometric mean of the gains"""
    gains: Float[Array, "k"]
    """exposure of each photo; its light is ``gain * light``"""
    albedo: Float[Array, "k a"]
    """albedo coefficients, standard deviations"""
    misfit: Float[Array, "k"]
    """weighted median over the vertices of ``|C - C_synth| / |C|`` of each photo"""


class SharedLight(NamedTuple):
    """The light that most of some photos share, and which of them do.

    Attributes:
        light: (9, 3) shading coefficients for a gain of 1; None where no two photos share one.
        gains: (k,) exposure of each photo under it.
        alike: (k,) photos that it explains about as well as their own does.
        misfit: (k,) of each photo under it.
        own_misfit: (k,) of each photo under its own.
    """

    light: Float[Array, "9 3"] | None
    gains: Float[Array, "k"]
    alike: Bool[np.ndarray, "k"]
    misfit: Float[Array, "k"]
    own_misfit: Float[np.ndarray, "k"]


@partial(jax.jit, static_argnames=("depth_size",))
def lit_vertices(
    y: FaceParameters,
    model: MorphableModel,
    image: Float[Array, "s s 3"],
    mask: Float[Array, "s s"],
    principal: Float[Array, "2"],
    *,
    depth_size: int = 256,
) -> LitVertices:
    """Sample a fitted photo at the vertices that it shows.

    Args:
        y: the fit.
        model: fitted; a coarse level of detail is enough.
        image: working image, linear RGB.
        mask: its pixels that show skin, 0 to 1.
        principal: principal point, fractions of the side.
        depth_size: of the depth buffer, px.
    """
    size = image.shape[0]
    shape = model.shape(y.identity, y.expression)
    rotation = rotation_matrix(y.rotation)
    unturned = vertex_normals(shape, model.faces)
    normal = unturned @ rotation.T
    posed = y.pose(shape)
    cosine = -jnp.sum(normal * safe_normalize(posed), axis=-1)
    camera = y.camera(principal, size)
    buffer = depth_buffer(posed, model.faces, camera, size, size, depth_size)
    screen = camera.project(posed)[:, :2]
    seen = bilinear(jnp.concatenate([image, mask[..., None]], axis=-1), screen)
    inside = jnp.all((screen > 1) & (screen < size - 1), axis=-1)
    weight = smoothstep(cosine, 0.2, 0.6) * seen[:, 3] * inside * buffer.unoccluded(posed, normal)
    harmonics = sh_basis(normal)
    if model.occlusion is not None:
        harmonics = harmonics + model.occlusion_of(unturned) @ sh_rotation(rotation).T
    return LitVertices(seen[:, :3], harmonics, weight)


@partial(jax.jit, static_argnames=("rounds",))
def common_light(
    photos: LitVertices,
    mean: Float[Array, "n 3"],
    basis: Float[Array, "n 3 a"],
    *,
    light: Float[Array, "9 3"] | None = None,
    prior: float = 1e-4,
    rounds: int = 30,
) -> CommonLight:
    """Solve for the light of several photos, their gains and albedos, by alternating least squares.

    Every photo counts the same, scaled to its own brightness; vertices count by their weight and
    the less the farther they are from what is explained (Cauchy, at the robust spread of their
    photo). With one photo this is a fit of its own light.

    Args:
        photos: k photos, stacked along the first axis, in one exposure or each in its own.
        mean: albedo of the mean face, linear RGB.
        basis: change of the albedo for one standard deviation of each coefficient.
        light: known already: only gains and albedos are sought.
        prior: weight of ``|alpha|^2`` in units of the mean squared relative residual.
        rounds: of light, gains and albedos in turn.

    Raises:
        ValueError: the shapes do not fit together, or there is no photo.
    """
    count, vertices = photos.weight.shape if photos.weight.ndim == 2 else (0, 0)
    if not count or photos.colour.shape != (count, vertices, 3):
        raise ValueError(
            f"colour has shape {photos.colour.shape}, weight {photos.weight.shape}; (k, n, 3) and "
            "(k, n) with one photo or more are needed"
        )
    if mean.shape != (vertices, 3) or basis.shape[:2] != (vertices, 3):
        raise ValueError(
            f"the photos have {vertices} vertices, mean {mean.shape} and basis {basis.shape}; "
            "they must be of one mesh"
        )
    share = photos.weight / jnp.maximum(jnp.sum(photos.weight, axis=1, keepdims=True), 1e-9)
    unit = jnp.sqrt(jnp.einsum("kn,knc->k", share, photos.colour**2) + 1e-12)
    colour = photos.colour / unit[:, None, None]
    dtype = colour.dtype
    # The ridge on the upper bands keeps what a face does not show of the sphere at rest.
    ridge = jnp.diag(jnp.array([1e-5] + [2e-3] * 8, dtype))

    def albedo_of(alpha: Array) -> Array:
        return mean + jnp.einsum("nca,ka->knc", basis, alpha)

    def robust(light: Array, gains: Array, alpha: Array) -> Array:
        shading = jnp.einsum("knj,jc->knc", photos.harmonics, light)
        off = safe_norm(colour - gains[:, None, None] * albedo_of(alpha) * shading)
        scale = jax.vmap(_weighted_median)(off, share)
        return share / (1.0 + (off / (2.0 * jnp.maximum(scale, 1e-3))[:, None]) ** 2)

    def solve_light(gains: Array, alpha: Array, weight: Array) -> Array:
        columns = gains[:, None, None] * albedo_of(alpha)
        gram = jnp.einsum(
            "kn,knc,kni,knj->cij", weight, columns**2, photos.harmonics, photos.harmonics,
            optimize="optimal",
        )  # fmt: skip
        right = jnp.einsum("kn,knc,kni->ci", weight, columns * colour, photos.harmonics)
        gram = gram + ridge * jnp.maximum(gram[:, :1, :1], 1e-9)
        return jnp.linalg.solve(gram, right[..., None])[..., 0].T

    def solve_albedo(light: Array, gain: Array, harmonics: Array, seen: Array, weight: Array):
        shading = gain * harmonics @ light
        columns = (shading[..., None] * basis).reshape(-1, basis.shape[-1])
        each = jnp.repeat(weight, 3)
        target = (seen - shading * mean).reshape(-1)
        gram = columns.T @ (each[:, None] * columns) + prior * jnp.eye(basis.shape[-1], dtype=dtype)
        return jnp.linalg.solve(gram, columns.T @ (each * target))

    def step(state: tuple[Array, Array, Array], _: None):
        current, gains, alpha = state
        weight = robust(current, gains, alpha)
        current = solve_light(gains, alpha, weight) if light is None else light
        model = albedo_of(alpha) * jnp.einsum("knj,jc->knc", photos.harmonics, current)
        above = jnp.einsum("kn,knc,knc->k", weight, model, colour)
        gains = above / jnp.maximum(jnp.einsum("kn,knc->k", weight, model**2), 1e-9)
        gains = jnp.maximum(gains, 1e-3)
        if light is None:
            # Gains in the photos' own units have a geometric mean of 1.
            scale = jnp.exp(jnp.mean(jnp.log(gains * unit)))
            gains, current = gains / scale, current * scale
        alpha = jax.vmap(solve_albedo, (None, 0, 0, 0, 0))(
            current, gains, photos.harmonics, colour, weight
        )
        return (current, gains, alpha), None

    ambient = jnp.zeros((9, 3), dtype).at[0].set(1.0 / Y0)
    start = (ambient if light is None else light, 1.0 / unit, jnp.zeros((count, basis.shape[-1])))
    # The first light is solved before its residuals are trusted.
    if light is None:
        start = (solve_light(start[1], start[2], share), *start[1:])
    (found, gains, alpha), _ = jax.lax.scan(step, start, None, length=rounds)
    shading = jnp.einsum("knj,jc->knc", photos.harmonics, found)
    synth = gains[:, None, None] * albedo_of(alpha) * shading
    off = safe_norm(colour - synth) / jnp.maximum(safe_norm(colour), 1e-3)
    return CommonLight(found, gains * unit, alpha, jax.vmap(_weighted_median)(off, share))


def shared_light(
    photos: Sequence[LitVertices],
    mean: Float[Array, "n 3"],
    basis: Float[Array, "n 3 a"],
    *,
    light: Float[Array, "9 3"] | None = None,
) -> SharedLight:
    """The common light of those photos that have one, each in its own exposure.

    A photo whose misfit under the common light is more than ``WORST_MISFIT`` times that under a
    light of its own is not under it, and must not bend the light that the rest share.

    Args:
        photos: what each shows.
        mean: albedo of the mean face, linear RGB.
        basis: change of the albedo for one standard deviation of each coefficient.
        light: known already, from other photos.

    Raises:
        ValueError: as ``common_light``.
    """
    stacked: LitVertices = jax.tree.map(lambda *x: jnp.stack(x), *photos)
    own = [common_light(jax.tree.map(lambda x: x[None], photo), mean, basis) for photo in photos]
    least = np.array([float(o.misfit[0]) for o in own])

    def alike(solved: CommonLight) -> Bool[np.ndarray, "k"]:
        return np.asarray(solved.misfit) <= WORST_MISFIT * np.maximum(least, 0.02)

    if light is None:
        solved = common_light(stacked, mean, basis)
        under = alike(solved)
        if under.sum() < 2:
            # A light that one photo alone follows is nobody's common light.
            return SharedLight(None, solved.gains, under, solved.misfit, least)
        if under.sum() < len(under):
            chosen = jax.tree.map(lambda x: x[np.flatnonzero(under)], stacked)
            solved = common_light(chosen, mean, basis)
        light = solved.light
    solved = common_light(stacked, mean, basis, light=light)
    return SharedLight(light, solved.gains, alike(solved), solved.misfit, least)


def _weighted_median(values: Float[Array, "n"], weight: Float[Array, "n"]) -> Float[Array, ""]:
    order = jnp.argsort(values)
    reached = jnp.cumsum(weight[order])
    middle = jnp.searchsorted(reached, 0.5 * reached[-1])
    return values[order[jnp.minimum(middle, len(values) - 1)]]
