"""Marks of pigment and blood: freckles, moles, age spots, blemishes."""

import jax.numpy as jnp

from jaxface._types import Array, Int
from jaxface.imaging.masks import smoothstep
from jaxface.models.skin.attributes import SkinAttributes
from jaxface.models.skin.noise import gradient_noise, layer_seed
from jaxface.models.skin.patch import SkinPatch
from jaxface.models.skin.pigments import Density
from jaxface.models.skin.rows import Row
from jaxface.models.skin.spots import Spot, gather_spots, likely


def freckles(patch: SkinPatch, traits: SkinAttributes, seed: Int[Array, ""]) -> Density:
    """Density of freckles: small irregular spots of melanin where the sun reaches."""
    r = patch.regions
    sun = r.skin * (1 - r.lips) * (1 - r.scalp) * (1 - 0.8 * r.lid) * (1 - r.neck)
    sun = sun * jnp.clip(0.25 + r.cheek + r.nose + 0.45 * r.forehead, 0.0, 1.2) * (1 - 0.5 * r.chin)
    ragged = 0.10 * gradient_noise(patch.position, 1.0, layer_seed(seed, 30))
    cluster = gradient_noise(patch.position, 16.0, layer_seed(seed, 31))
    chance = traits.freckles * (0.75 + 0.2 * cluster) * sun

    def spots(cell: float, size: float, layer: int) -> Row:
        def shade(spot: Spot) -> Row:
            u, v, w = spot.random
            reach = jnp.sqrt(spot.distance2) / (size * (0.35 + 0.65 * v * v)) + ragged
            return likely(chance, u, 14.0) * spot.on_surface * (0.3 + 0.7 * w) * _rim(reach, 0.65)

        return gather_spots(patch.position, patch.normal, cell, layer_seed(seed, layer), shade)

    density = 0.34 * spots(2.0, 0.6, 32) + 0.26 * spots(3.6, 1.15, 33)
    density = density * jnp.sqrt(traits.freckles)
    return Density(density, 0.1 * density)


def marks(patch: SkinPatch, traits: SkinAttributes, seed: Int[Array, ""]) -> Density:
    """Density of moles (few, dark), age spots (broad, faint) and blemishes (red)."""
    r = patch.regions
    bare = r.skin * (1 - r.lips) * (1 - r.scalp)
    ragged = 0.08 * gradient_noise(patch.position, 2.0, layer_seed(seed, 40))

    def spots(
        layer: int, cell: float, chance: Row | Array, size: tuple[float, float], soft: float
    ) -> Row:
        def shade(spot: Spot) -> Row:
            u, v, w = spot.random
            radius = size[0] + (size[1] - size[0]) * v * v * v
            reach = jnp.sqrt(spot.distance2) / radius + ragged
            present = (u < chance) * jnp.minimum(4.0 * spot.on_surface, 1.0)
            return present * (0.35 + 0.65 * w) * _rim(reach, soft)

        seed_of = layer_seed(seed, 41 + layer)
        return bare * gather_spots(patch.position, patch.normal, cell, seed_of, shade)

    mole = spots(0, 17.0, 0.01 + 0.09 * traits.moles, (0.4, 1.7), 0.45)
    tiny = spots(1, 9.0, 0.02 + 0.10 * traits.moles, (0.25, 0.5), 0.6)
    where = 0.4 + r.forehead + r.cheek
    brown = spots(2, 9.0, 0.35 * traits.age_spots * where, (0.9, 4.2), 0.5)
    where = 0.3 + r.chin + 0.8 * r.cheek + 0.6 * r.forehead
    red = spots(3, 9.0, 0.12 * traits.blemishes * where, (0.5, 2.4), 0.95)
    melanin = 0.85 * mole + 0.45 * tiny + 0.22 * brown
    return Density(melanin, 0.3 * red + 0.25 * mole + 0.1 * tiny, 0.15 * mole)


def _rim(reach: Row, soft: float) -> Row:
    """1 inside a spot of radius 1, falling to 0 over the last ``soft`` part of it."""
    return smoothstep(1.0 - reach, 0.0, soft)
