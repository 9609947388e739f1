"""A whole skin: the layers summed as optical densities over the model's own albedo."""

import functools

import jax
import jax.numpy as jnp

from jaxface._types import Array, Float, Int
from jaxface.geometry.uv import UVLayout
from jaxface.imaging.push_pull import push_pull
from jaxface.models.morphable import MorphableModel
from jaxface.models.skin.attributes import SkinAttributes
from jaxface.models.skin.furrows import furrows
from jaxface.models.skin.lesions import freckles, moles
from jaxface.models.skin.mottling import mottling, regional_tone
from jaxface.models.skin.noise import mix
from jaxface.models.skin.patch import SkinPatch, patch_at
from jaxface.models.skin.pigments import absorb
from jaxface.models.skin.pores import pores
from jaxface.models.skin.regions import SkinFields, skin_fields
from jaxface.models.skin.stubble import stubble

RUN = 1 << 16
"""texels computed at once: the temporaries of a run are what a texture of any size needs"""
BRIGHTEST = 0.92


def synthesise_skin(
    model: MorphableModel,
    layout: UVLayout,
    attributes: SkinAttributes,
    key: Array,
    fields: SkinFields | None = None,
) -> Float[Array, "r r 3"]:
    """Albedo texture of one subject in a model's UVs.

    Features have their size in millimetres on the model's mean face, so the same subject is the
    same person at any resolution; what a texel is too coarse for is left out, not aliased.

    Args:
        model: gives the shape, the landmarks and the base albedo.
        layout: of the model's UVs; its resolution is the texture's.
        attributes: traits of the subject.
        key: places pores, spots and hairs.
        fields: of the model, where they are already known.

    Returns:
        Linear RGB; outside the UV islands the islands' colours continue.
    """
    fields = skin_fields(model) if fields is None else fields
    seed = mix(jax.random.bits(key, (), jnp.uint32))
    tone = (
        jnp.zeros(model.albedo.count)
        .at[1 : 1 + attributes.tone.shape[0]]
        .set(attributes.tone[: model.albedo.count - 1])
    )
    base = jnp.clip(model.reflectance(tone), 0.004, 1.0)
    colour = _texels(
        fields, base, model.faces, layout.triangle, layout.barycentric, attributes, seed
    )
    return fill_outside(colour, layout.triangle >= 0)


@functools.partial(jax.jit, static_argnames=())
def _texels(fields, base, faces, triangle, barycentric, attributes, seed):
    side = triangle.shape[0]
    count = side * side
    padding = -count % RUN if count > RUN else 0
    flat = jnp.pad(triangle.reshape(-1), (0, padding), constant_values=-1)
    weights = jnp.pad(barycentric.reshape(-1, 2), ((0, padding), (0, 0)))
    runs = max((count + padding) // RUN, 1)

    def one(run: tuple[Array, Array]) -> Array:
        index, share = run
        patch, albedo = patch_at(fields, base, faces, jnp.maximum(index, 0), share, side)
        return jax.lax.cond(
            jnp.any(index >= 0), lambda: _skin(patch, albedo, attributes, seed), lambda: albedo
        ).T

    colour = jax.lax.map(one, (flat.reshape(runs, -1), weights.reshape(runs, -1, 2)))
    return colour.reshape(-1, 3)[:count].reshape(side, side, 3)


def _skin(
    patch: SkinPatch, base: Float[Array, "3 n"], traits: SkinAttributes, seed: Int[Array, ""]
) -> Float[Array, "3 n"]:
    """Colour of a run of texels."""
    density = regional_tone(patch, traits) + mottling(patch, traits, seed)
    density = density + pores(patch, traits, seed) + furrows(patch, traits, seed)
    none = jnp.zeros_like(density)
    r = patch.regions
    for layer, needed in (
        (freckles, traits.freckles > 0.02),
        (moles, jnp.any(r.skin > 0)),
        (stubble, (traits.stubble > 0.02) & jnp.any(r.beard > 0.05)),
    ):
        density = density + jax.lax.cond(
            needed, lambda layer=layer: layer(patch, traits, seed), lambda: none
        )
    density = density * r.skin
    return jnp.clip(absorb(base, density), 0.002, BRIGHTEST)


def fill_outside(texture: Float[Array, "r r c"], known: Array) -> Float[Array, "r r c"]:
    """The texture with its unknown texels continued smoothly from the known ones."""
    side = texture.shape[0]
    block = max(side // 256, 1)
    if side % block:
        block = 1
    weight = known.astype(texture.dtype)
    coarse = side // block

    def pooled(x: Array) -> Array:
        return x.reshape(coarse, block, coarse, block, -1).mean((1, 3))

    share = pooled(weight)
    mean = pooled(texture * weight[..., None]) / jnp.maximum(share, 1e-6)
    filled = push_pull(mean, (share[..., 0] > 0).astype(texture.dtype))
    wide = jax.image.resize(filled, texture.shape, "linear")
    return jnp.where(known[..., None], texture, wide)
