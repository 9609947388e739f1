"""Marks of pigment and blood: freckles, moles, age spots, blemishes."""

import jax
import jax.numpy as jnp

from jaxface._types import Array, Float, Int
from jaxface.models.skin.attributes import SkinAttributes
from jaxface.models.skin.noise import gradient_noise, layer_seed
from jaxface.models.skin.patch import SkinPatch
from jaxface.models.skin.spots import Spot, gather_spots


def freckles(patch: SkinPatch, traits: SkinAttributes, seed: Int[Array, ""]) -> Float[Array, "3 n"]:
    """Density of freckles: small irregular spots of melanin where the sun reaches."""
    r = patch.regions
    sun = r.skin * (1 - r.lips) * (1 - r.scalp) * (1 - 0.8 * r.lid) * (1 - r.neck)
    sun = sun * jnp.clip(0.25 + r.cheek + r.nose + 0.45 * r.forehead, 0, 1.2) * (1 - 0.5 * r.chin)
    ragged = 0.45 * gradient_noise(patch.position, 1.1, layer_seed(seed, 30))
    cluster = gradient_noise(patch.position, 14.0, layer_seed(seed, 31))
    density = jnp.zeros_like(r.skin)
    for layer, (cell, size, strength) in enumerate(((2.0, 0.55, 0.38), (3.6, 1.05, 0.30))):
        share = traits.freckles * (0.75 + 0.25 * cluster) * sun

        def shade(spot: Spot, share=share, size=size) -> Array:
            u, v, w = spot.random
            radius = size * (0.35 + 0.65 * v * v)
            reach = jnp.sqrt(spot.distance2) / radius * (1.0 + 0.35 * ragged)
            present = jax.nn.sigmoid((share - u) * 14.0)
            return present * spot.on_surface * (0.3 + 0.7 * w) * _rim(reach, 0.55)

        spots = gather_spots(
            patch.position, patch.normal, cell, layer_seed(seed, 32 + layer), shade
        )
        density = density + strength * spots
    density = density * jnp.sqrt(traits.freckles)
    return jnp.stack([density, 0.1 * density, jnp.zeros_like(density)])


def moles(patch: SkinPatch, traits: SkinAttributes, seed: Int[Array, ""]) -> Float[Array, "3 n"]:
    """Density of moles (few, dark), age spots (broad, faint) and blemishes (red)."""
    r = patch.regions
    bare = r.skin * (1 - r.lips) * (1 - r.scalp)
    ragged = 0.3 * gradient_noise(patch.position, 2.2, layer_seed(seed, 40))

    def scattered(layer: int, cell: float, amount: Array, size: tuple[float, float], soft: float):
        def shade(spot: Spot) -> Array:
            u, v, w = spot.random
            radius = size[0] + (size[1] - size[0]) * v * v
            reach = jnp.sqrt(spot.distance2) / radius * (1.0 + 0.35 * ragged)
            return (
                (u < amount)
                * jnp.minimum(3 * spot.on_surface, 1.0)
                * (0.4 + 0.6 * w)
                * _rim(reach, soft)
            )

        return bare * gather_spots(
            patch.position, patch.normal, cell, layer_seed(seed, 41 + layer), shade
        )

    mole = scattered(0, 13.0, 0.01 + 0.10 * traits.moles, (0.35, 1.5), 0.35)
    tiny = scattered(1, 7.0, 0.02 + 0.10 * traits.moles, (0.2, 0.45), 0.5)
    brown = scattered(
        2, 9.0, 0.35 * traits.age_spots * (0.4 + r.forehead + r.cheek), (0.9, 4.0), 0.5
    )
    red = scattered(
        3,
        8.0,
        0.14 * traits.blemishes * (0.4 + r.chin + r.cheek + 0.6 * r.forehead),
        (0.5, 2.2),
        0.9,
    )
    melanin = 0.9 * mole + 0.7 * tiny + 0.28 * brown
    return jnp.stack([melanin, 0.45 * red + 0.2 * mole, 0.15 * mole])


def _rim(reach: Float[Array, "n"], soft: float) -> Float[Array, "n"]:
    """1 inside a spot of radius 1, falling to 0 over the last ``soft`` part of it."""
    t = jnp.clip((1.0 - reach) / soft, 0.0, 1.0)
    return t * t * (3 - 2 * t)
