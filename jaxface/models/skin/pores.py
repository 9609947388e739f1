"""Pores: dark dots with soft rims, dense and large on the nose, fine on the forehead."""

import jax
import jax.numpy as jnp

from jaxface._types import Array, Float, Int
from jaxface.models.skin.attributes import SkinAttributes
from jaxface.models.skin.noise import layer_seed
from jaxface.models.skin.patch import SkinPatch
from jaxface.models.skin.spots import Spot, gather_spots, soft_disc

# Spacing (mm) of the large pores and of the many small ones between them.
CELLS = (1.15, 0.62)
ELONGATION = 1.35
"""length over width, along the lines of tension"""


def pores(patch: SkinPatch, traits: SkinAttributes, seed: Int[Array, ""]) -> Float[Array, "3 n"]:
    """Density of the pores (rows of `pigments.PIGMENTS`)."""
    r = patch.regions
    bare = r.skin * (1 - r.lips) * (1 - r.lid) * (1 - 0.8 * r.scalp) * (1 - r.ear)
    large = bare * jnp.clip(
        0.25 + 0.75 * r.nose + 0.65 * r.cheek + 0.3 * r.chin + 0.15 * r.forehead, 0, 1
    )
    depth = jnp.zeros_like(r.skin)
    for layer, (cell, share, size, strength) in enumerate(
        ((CELLS[0], 0.2 + 0.75 * large, 0.18 + 0.17 * large, 0.8), (CELLS[1], 0.9, 0.19, 0.34))
    ):
        amount = (large if layer == 0 else bare) * strength

        def shade(spot: Spot, share=share, size=size) -> Array:
            u, v, w = spot.random
            along = sum(d * t for d, t in zip(spot.offset, patch.tension, strict=True))
            stretched = spot.distance2 - (1 - 1 / ELONGATION**2) * along * along
            present = jax.nn.sigmoid((share - u) * 12.0)
            radius = size * (0.65 + 0.7 * v) * jnp.sqrt(traits.pores)
            return (
                present
                * spot.on_surface
                * (0.35 + 0.65 * w)
                * soft_disc(stretched * ELONGATION, radius, patch.texel)
            )

        spots = gather_spots(
            patch.position, patch.normal, cell, layer_seed(seed, 10 + layer), shade
        )
        depth = depth + amount * spots
    depth = depth * traits.pores
    return jnp.stack([0.35 * depth, 0.3 * depth, 0.45 * depth])
