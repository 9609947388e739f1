"""A whole skin: the layers summed as optical densities over the model's own albedo."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxface._types import Array, Bool, Float, Int
from jaxface.geometry.uv import UVLayout
from jaxface.imaging.push_pull import push_pull
from jaxface.models.morphable import MorphableModel
from jaxface.models.skin.attributes import SkinAttributes
from jaxface.models.skin.furrows import furrows
from jaxface.models.skin.hair import brows, down, scalp_roots, stubble
from jaxface.models.skin.lesions import freckles, marks
from jaxface.models.skin.lips import lips
from jaxface.models.skin.mottling import mottling, regional_tone, veins
from jaxface.models.skin.noise import mix
from jaxface.models.skin.patch import SkinPatch, patch_at
from jaxface.models.skin.pigments import Density, absorb
from jaxface.models.skin.pores import pores
from jaxface.models.skin.regions import SkinFields, skin_fields
from jaxface.models.skin.rows import Vector
from jaxface.models.skin.wrinkles import wrinkles

Layer = Callable[[SkinPatch, SkinAttributes, Int[Array, ""]], Density]

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

    Raises:
        ValueError: the model has no 68 landmarks.
    """
    fields = skin_fields(model) if fields is None else fields
    return _texture(model, layout, attributes, jax.random.bits(key, (), jnp.uint32), fields)


@jax.jit
def _texture(
    model: MorphableModel,
    layout: UVLayout,
    attributes: SkinAttributes,
    seed: Int[Array, ""],
    fields: SkinFields,
) -> Float[Array, "r r 3"]:
    side, seed = layout.resolution, mix(seed)
    base = base_albedo(model, attributes, fields)
    count = side * side
    run = min(RUN, count)
    padding = -count % run
    triangle = jnp.pad(layout.triangle.reshape(-1), (0, padding), constant_values=-1)
    weights = jnp.pad(layout.barycentric.reshape(-1, 2), ((0, padding), (0, 0)))

    def one(texels: tuple[Array, Array]) -> Vector:
        index, share = texels

        def paint() -> Vector:
            patch, albedo = patch_at(fields, base, model.faces, jnp.maximum(index, 0), share, side)
            return _skin(patch, albedo, attributes, seed)

        def nothing() -> Vector:
            return (jnp.zeros(run), jnp.zeros(run), jnp.zeros(run))

        return jax.lax.cond(jnp.any(index >= 0), paint, nothing)

    rows = jax.lax.map(one, (triangle.reshape(-1, run), weights.reshape(-1, run, 2)))
    colour = jnp.stack([row.reshape(-1)[:count].reshape(side, side) for row in rows], axis=-1)
    return fill_outside(colour, layout.triangle >= 0)


def base_albedo(
    model: MorphableModel, attributes: SkinAttributes, fields: SkinFields
) -> Float[Array, "n 3"]:
    """The model's mean albedo with the subject's tone, and cleaner lips and lids.

    The first mode, overall darkness, is left to the pigments. Averaged textures mix teeth and
    shadow into the lips, whose colour is drawn together here; for their rims and the lids' see
    `models.opening_rims`.
    """
    modes = min(model.albedo.count - 1, attributes.tone.shape[0])
    tone = jnp.zeros(model.albedo.count)
    if modes > 0:
        tone = tone.at[1 : 1 + modes].set(attributes.tone[:modes])
    albedo = jnp.clip(fields.rims.calm(model.reflectance(tone)), 0.004, 1.0)
    r = fields.regions

    def mean_over(weight: Float[Array, "n"]) -> Float[Array, "3"]:
        return weight @ albedo / jnp.maximum(jnp.sum(weight), 1e-6)

    lip, cheek = mean_over(r.lips * (r.lips > 0.9)), mean_over(r.cheek)
    pale = 0.2 + 0.3 * attributes.male
    return albedo + (0.8 * r.lips)[:, None] * ((1 - pale) * lip + pale * cheek - albedo)


def _skin(patch: SkinPatch, base: Vector, traits: SkinAttributes, seed: Int[Array, ""]) -> Vector:
    """Colour of a run of texels."""
    r = patch.regions
    count = r.skin.shape[0]

    def where(needed: Array, layer: Layer) -> Density:
        # Runs that do not need a layer skip it, and XLA cannot fuse it into the other layers.
        def paint() -> tuple[Array, ...]:
            return tuple(jnp.broadcast_to(row, (count,)) for row in layer(patch, traits, seed))

        return Density(*jax.lax.cond(needed, paint, lambda: (jnp.zeros(count),) * 3))

    skin = jnp.any(r.skin > 0)
    density = regional_tone(patch, traits).plus(
        where(skin, mottling),
        where(skin, pores),
        where(skin, furrows),
        where(skin, down),
        where(skin, marks),
        where(jnp.any(r.nose + r.cheek > 0.15), veins),
        where(traits.freckles > 0.02, freckles),
        where((traits.stubble > 0.02) & jnp.any(r.beard > 0.05), stubble),
        where(jnp.any(r.brow > 0.1), brows),
        where(jnp.any(r.scalp > 0.05), scalp_roots),
        where(jnp.any(patch.position[2] > 0), wrinkles),
        where(jnp.any((r.lips > 0.02) | (r.beard > 0.05)), lips),
    )
    red, green, blue = (
        jnp.clip(channel, 0.002, BRIGHTEST) for channel in absorb(base, density.times(r.skin))
    )
    return red, green, blue


def fill_outside(
    texture: Float[Array, "r r c"], known: Bool[Array, "r r"]
) -> Float[Array, "r r c"]:
    """The texture with its unknown texels continued smoothly from the known ones.

    Far from the islands detail is no use, so the continuation is made at 256 texels a side.
    """
    side = texture.shape[0]
    block = side // 256 if side > 256 and side % 256 == 0 else 1
    coarse = side // block

    def pooled(x: Array) -> Array:
        return x.reshape(coarse, block, coarse, block, -1).mean((1, 3))

    share = pooled(known.astype(texture.dtype))
    mean = pooled(texture * known[..., None]) / jnp.maximum(share, 1e-6)
    filled = push_pull(mean, jnp.minimum(share[..., 0] * 1e6, 1.0))
    wide = jax.image.resize(filled, texture.shape, "linear")
    return jnp.where(known[..., None], texture, wide)
