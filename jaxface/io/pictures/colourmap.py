"""Colour maps that are even to the eye, drawn as curves in the Oklab space."""

import numpy as np

from jaxface._types import Float

# Oklab -> cone response and cone response -> linear sRGB: B. Ottosson, "A perceptual color space
# for image processing", 2020.
_LAB_TO_LMS = np.array(
    [
        [1.0, 0.3963377774, 0.2158037573],
        [1.0, -0.1055613458, -0.0638541728],
        [1.0, -0.0894841775, -1.2914855480],
    ]
)
_LMS_TO_RGB = np.array(
    [
        [4.0767416621, -3.3077115913, 0.2309699292],
        [-1.2684380046, 2.6097574011, -0.3413193965],
        [-0.0041960863, -0.7034186147, 1.7076147010],
    ]
)


def oklab_to_srgb(lab: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Oklab (lightness 0-1, a, b) to sRGB (0-1); what lies outside the gamut is clipped."""
    linear = np.clip((lab @ _LAB_TO_LMS.T) ** 3 @ _LMS_TO_RGB.T, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def sequential(t: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch 3"]:
    """SRGB of values 0-1: from dark violet by magenta and orange to pale yellow.

    Lightness rises linearly with the value, so a greyscale print keeps the order.
    """
    t = np.clip(t, 0.0, 1.0)
    hue = np.deg2rad(285.0 + 180.0 * t)
    chroma = 0.03 + 0.17 * np.sin(np.pi * np.clip(0.06 + 0.86 * t, 0, 1)) ** 1.1
    return oklab_to_srgb(
        np.stack([0.16 + 0.80 * t, chroma * np.cos(hue), chroma * np.sin(hue)], axis=-1)
    )


def diverging(t: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch 3"]:
    """SRGB of values 0-1 about the neutral 0.5: blue below, near-white at it, red above."""
    signed = 2.0 * np.clip(t, 0.0, 1.0) - 1.0
    strength = np.abs(signed)
    hue = np.deg2rad(np.where(signed < 0, 255.0, 30.0))
    chroma = 0.16 * np.sin(0.5 * np.pi * np.minimum(strength * 1.25, 1.0))
    return oklab_to_srgb(
        np.stack([0.96 - 0.52 * strength, chroma * np.cos(hue), chroma * np.sin(hue)], axis=-1)
    )
