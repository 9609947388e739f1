"""Blotches: slow and quick variation of blood and melanin, and regional differences."""

import jax.numpy as jnp

from jaxface._types import Array, Int
from jaxface.imaging.masks import smoothstep
from jaxface.models.skin.attributes import SkinAttributes
from jaxface.models.skin.noise import gradient_noise, layer_seed, spectrum_noise
from jaxface.models.skin.patch import SkinPatch
from jaxface.models.skin.pigments import Density

WAVES = (32.0, 16.0, 8.0, 4.0, 2.0, 1.0, 0.55)
"""mm"""
BLOOD = (0.034, 0.028, 0.019, 0.013, 0.010, 0.006, 0.003)
"""standard deviation of the density of each wave"""
MELANIN = (0.018, 0.014, 0.011, 0.009, 0.009, 0.005, 0.003)


def mottling(patch: SkinPatch, traits: SkinAttributes, seed: Int[Array, ""]) -> Density:
    """Density of the blotches: two independent noises of all scales."""
    blood = spectrum_noise(patch.position, WAVES, BLOOD, patch.texel, layer_seed(seed, 1))
    melanin = spectrum_noise(patch.position, WAVES, MELANIN, patch.texel, layer_seed(seed, 2))
    r = patch.regions
    vivid = traits.mottling * (
        1.0 + 0.8 * r.cheek + 0.3 * r.nose + 0.2 * r.chin - 0.35 * r.forehead
    )
    return Density(traits.mottling * melanin, vivid * blood)


def regional_tone(patch: SkinPatch, traits: SkinAttributes) -> Density:
    """Density by which regions differ from the base: flushed cheeks and nose, shaded under-eyes."""
    r = patch.regions
    flush = 0.11 * r.cheek + 0.12 * r.nose + 0.12 * r.ear + 0.06 * r.chin - 0.05 * r.forehead
    tired = 0.5 + 0.5 * jnp.clip((traits.age - 20.0) / 50.0, 0.0, 1.0)
    blood = traits.haemoglobin + traits.flush * flush + 0.07 * tired * r.under_eye - 0.04 * r.lid
    dark = jnp.clip(traits.melanin, 0.0, 1.5)
    melanin = traits.melanin * (1.0 - 0.12 * r.lips) + r.under_eye * tired * (0.05 + 0.06 * dark)
    melanin = melanin + 0.04 * r.forehead * dark
    blood = blood + 0.05 * dark * r.lips
    return Density(melanin, blood, 0.03 * tired * r.under_eye)


def veins(patch: SkinPatch, traits: SkinAttributes, seed: Int[Array, ""]) -> Density:
    """Density of fine widened vessels beside the nose and on the cheeks (telangiectasia).

    They are the zero lines of a noise, broken by another.
    """
    r = patch.regions
    where = jnp.clip(0.9 * r.nose + 0.8 * r.cheek - 0.15, 0.0, 1.0)
    amount = where * jnp.clip((traits.age - 25.0) / 45.0, 0.1, 1.0) * traits.flush
    branches = jnp.zeros_like(where)
    for layer, (wave, width) in enumerate(((5.0, 0.25), (2.6, 0.19))):
        line = jnp.abs(gradient_noise(patch.position, wave, layer_seed(seed, 3 + layer)))
        wide = width + 4.4 * patch.texel / wave
        branches = branches + jnp.square(jnp.clip(1.0 - line / wide, 0.0, 1.0)) * width / wide
    broken = smoothstep(gradient_noise(patch.position, 4.0, layer_seed(seed, 5)), 0.15, 1.85)
    return Density(0.0, 0.16 * amount * broken * branches)
