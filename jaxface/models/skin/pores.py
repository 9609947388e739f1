"""Pores: dark dots with soft rims, dense and large on the nose, fine on the forehead."""

import jax.numpy as jnp

from jaxface._types import Array, Int
from jaxface.models.skin.attributes import SkinAttributes
from jaxface.models.skin.noise import layer_seed
from jaxface.models.skin.patch import SkinPatch
from jaxface.models.skin.pigments import Density
from jaxface.models.skin.rows import Row, dot
from jaxface.models.skin.spots import Spot, gather_spots, likely, soft_disc

LARGE_CELL, SMALL_CELL = 1.1, 0.7
"""spacing (mm) of the large pores and of the small ones between them"""
ELONGATION = 1.4
"""length over width, along the lines of tension"""
SCATTER = 0.2
"""mm, how far light spreads under the skin"""


def pores(patch: SkinPatch, traits: SkinAttributes, seed: Int[Array, ""]) -> Density:
    """Density of the pores."""
    r = patch.regions
    bare = r.skin * (1 - r.lips) * (1 - r.lid) * (1 - 0.7 * r.scalp) * (1 - 0.8 * r.ear)
    bare = bare * (1 - 0.8 * r.under_eye)
    strong = jnp.clip(
        0.15 + 0.85 * r.nose + 0.6 * r.cheek + 0.35 * r.chin + 0.2 * r.forehead, 0.0, 1.0
    )
    size = jnp.sqrt(traits.pores)
    # Light spreads under the skin: no pore shows sharper than that.
    blur = jnp.sqrt(patch.texel * patch.texel + SCATTER * SCATTER)

    def dots(cell: float, chance: Row, radius: Row, layer: int) -> Row:
        def shade(spot: Spot) -> Row:
            u, v, w = spot.random
            along = dot(spot.offset, patch.tension)
            squared = spot.distance2 * ELONGATION - (ELONGATION - 1 / ELONGATION) * along * along
            disc = soft_disc(squared, radius * (0.55 + 0.75 * v * w), blur)
            return likely(chance, u) * spot.on_surface * (0.4 + 0.6 * w) * disc

        return gather_spots(patch.position, patch.normal, cell, layer_seed(seed, layer), shade)

    large = dots(LARGE_CELL, 0.25 + 0.7 * strong, (0.17 + 0.13 * strong) * size, 10)
    small = dots(SMALL_CELL, 0.5 + 0.4 * strong, (0.17 + 0.03 * strong) * size, 11)
    # Sebum and shadow darken the mouth of a pore; a faint red rim lies around the larger.
    depth = bare * size * (0.6 * strong * large + 0.3 * small)
    return Density(0.4 * depth, 0.35 * depth, 0.4 * depth)
