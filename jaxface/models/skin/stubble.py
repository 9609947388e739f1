"""Beard stubble: short strokes of hair, and the blue-grey of the roots under the skin."""

import jax
import jax.numpy as jnp

from jaxface._types import Array, Float, Int
from jaxface.models.skin.attributes import SkinAttributes
from jaxface.models.skin.noise import gradient_noise, layer_seed
from jaxface.models.skin.patch import SkinPatch
from jaxface.models.skin.spots import Spot, gather_spots

CELL = 1.0
"""mm; a stroke is at most as long"""
LAYERS = 2
WIDTH = 0.075
"""mm, half the width of a hair as a soft line"""


def stubble(patch: SkinPatch, traits: SkinAttributes, seed: Int[Array, ""]) -> Float[Array, "3 n"]:
    """Density of the beard (rows of `pigments.PIGMENTS`)."""
    patchy = gradient_noise(patch.position, 11.0, layer_seed(seed, 50))
    wander = 0.5 * gradient_noise(patch.position, 6.0, layer_seed(seed, 51))
    where = jnp.clip(patch.regions.beard * (1.1 + 0.22 * patchy) - 0.12, 0.0, 1.0)
    across = _cross(patch.normal, patch.hair)
    texel2 = patch.texel * patch.texel
    hairs = jnp.zeros_like(where)
    for layer in range(LAYERS):

        def shade(spot: Spot) -> Array:
            u, v, w = spot.random
            lean = wander + (w - 0.5) * 0.9
            along = sum(d * t for d, t in zip(spot.offset, patch.hair, strict=True))
            side = sum(d * t for d, t in zip(spot.offset, across, strict=True))
            side, along = side - lean * along, along + lean * side
            length = (0.12 + 0.30 * v) * (0.5 + 0.5 * traits.stubble)
            wide2 = WIDTH * WIDTH + 0.4 * texel2
            long2 = length * length + 0.4 * texel2
            fall = jnp.maximum(1.0 - side * side / (2.5 * wide2) - along * along / long2, 0.0)
            volume = WIDTH * length * jax.lax.rsqrt(wide2 * long2)
            present = jax.nn.sigmoid((where - u) * 10.0) * jnp.minimum(where * 6, 1.0)
            return present * spot.on_surface * fall * (0.5 + 0.5 * u) * volume

        hairs = hairs + gather_spots(
            patch.position, patch.normal, CELL, layer_seed(seed, 52 + layer), shade
        )
    amount = traits.stubble * (0.35 + 0.65 * traits.hair_melanin)
    shadow = 0.16 * amount * where
    dark = 1.5 * amount * hairs
    # Roots seen through the skin look blue: they take away red, so melanin's share is negative.
    return jnp.stack([0.3 * dark - 0.45 * shadow, -0.1 * shadow, 0.8 * dark + 1.5 * shadow])


def _cross(a: Float[Array, "3 n"], b: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
    return jnp.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )
