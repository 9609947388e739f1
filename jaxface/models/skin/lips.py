"""Lips: upright grooves, blotches, and a border sharper than the base albedo has it."""

import jax.numpy as jnp

from jaxface._types import Array, Int
from jaxface.imaging.masks import smoothstep
from jaxface.models.skin.attributes import SkinAttributes
from jaxface.models.skin.noise import gradient_noise, layer_seed, visible
from jaxface.models.skin.patch import SkinPatch
from jaxface.models.skin.pigments import Density
from jaxface.models.skin.rows import Row


def lips(patch: SkinPatch, traits: SkinAttributes, seed: Int[Array, ""]) -> Density:
    """Density of the lips' grooves and of the red of their border; fine lines above an old lip."""
    x, y, z = patch.position
    middle = patch.landmarks[48:60].mean(0)
    ragged = 0.065 * gradient_noise(patch.position, 2.2, layer_seed(seed, 110))
    inside = smoothstep(patch.regions.lips + ragged, 0.25, 0.85)
    # Grooves fan out towards the corners; along themselves they vary five times more slowly.
    fan = x * (1.0 - 0.012 * jnp.abs(y - middle[1]))
    warp = 0.18 * gradient_noise(patch.position, 5.0, layer_seed(seed, 111))
    grain = (fan + warp, 0.2 * y, 0.2 * z)

    def grooves(wave: float, layer: int) -> Row:
        line = 1.0 - jnp.abs(gradient_noise(grain, wave, layer_seed(seed, layer))) * 0.7
        return visible(wave, patch.texel) * jnp.square(jnp.clip(line, 0.0, 1.0))

    groove = 0.9 * grooves(2.4, 112) + 0.7 * grooves(1.3, 113)
    blotch = gradient_noise(patch.position, 4.0, layer_seed(seed, 114))
    above = jnp.clip(patch.regions.beard - patch.regions.lips, 0.0, 1.0)
    above = (
        above
        * smoothstep(-jnp.abs(x), -24.0, -8.0)
        * smoothstep(-jnp.abs(y - middle[1]), -16.0, -8.0)
    )
    old = 0.05 * traits.wrinkles * traits.wrinkles * above * groove
    redder = 0.02 + 0.09 * groove + 0.023 * blotch
    return Density(
        inside * 0.03 * groove + 0.3 * old,
        inside * redder + 0.4 * old,
        inside * 0.05 * groove + old,
    )
