"""Blotches: slow variation of blood and melanin over the face, and its regional differences."""

import jax.numpy as jnp

from jaxface._types import Array, Float, Int
from jaxface.models.skin.attributes import SkinAttributes
from jaxface.models.skin.noise import layer_seed, spectrum_noise
from jaxface.models.skin.patch import SkinPatch

# mm, and the standard deviation of the optical density in green of each wavelength.
BLOOD_WAVES = (28.0, 13.0, 6.0, 3.0, 1.5, 0.8, 0.45)
BLOOD_AMPLITUDES = (0.030, 0.026, 0.022, 0.018, 0.014, 0.012, 0.010)
MELANIN_WAVES = (36.0, 16.0, 7.0, 3.2, 1.6, 0.9, 0.5)
MELANIN_AMPLITUDES = (0.030, 0.022, 0.018, 0.014, 0.010, 0.009, 0.008)


def mottling(patch: SkinPatch, traits: SkinAttributes, seed: Int[Array, ""]) -> Float[Array, "3 n"]:
    """Density of the blotches (rows of `pigments.PIGMENTS`)."""
    blood = spectrum_noise(
        patch.position, BLOOD_WAVES, BLOOD_AMPLITUDES, patch.texel, layer_seed(seed, 1)
    )
    melanin = spectrum_noise(
        patch.position, MELANIN_WAVES, MELANIN_AMPLITUDES, patch.texel, layer_seed(seed, 2)
    )
    vivid = 1.0 + 0.5 * patch.regions.cheek + 0.4 * patch.regions.nose + 0.3 * patch.regions.chin
    return traits.mottling * jnp.stack([melanin, blood * vivid, jnp.zeros_like(blood)])


def regional_tone(patch: SkinPatch, traits: SkinAttributes) -> Float[Array, "3 n"]:
    """Density by which regions differ from the base: flushed cheeks and nose, shaded under-eyes."""
    r = patch.regions
    flush = 0.10 * r.cheek + 0.10 * r.nose + 0.12 * r.ear + 0.05 * r.chin - 0.05 * r.forehead
    tired = 0.5 + 0.5 * jnp.clip((traits.age - 20.0) / 50.0, 0.0, 1.0)
    blood = traits.haemoglobin + traits.flush * flush + 0.06 * tired * r.under_eye - 0.04 * r.lid
    dark = jnp.clip(traits.melanin, 0.0, 1.5)
    melanin = traits.melanin * (1.0 - 0.35 * r.lips) + r.under_eye * tired * (0.05 + 0.05 * dark)
    melanin = melanin + 0.04 * r.forehead * dark
    return jnp.stack([melanin, blood, 0.03 * tired * r.under_eye])
