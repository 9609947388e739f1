"""Colour: the sRGB transfer curve, luminance, and the YIQ space of Saito 2017 (section 4)."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Float

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Rec. 709 luminance of linear RGB"""

RGB_TO_YIQ = np.array(
    [
        [0.299, 0.587, 0.114],
        [0.59590059, -0.27455667, -0.32134392],
        [0.21153661, -0.52273617, 0.31119955],
    ]
)
"""NTSC (1953) matrix; rows are Y, I, Q"""

YIQ_TO_RGB = np.linalg.inv(RGB_TO_YIQ)


@jax.jit
def srgb_to_linear(encoded: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Decode sRGB values to linear light (IEC 61966-2-1, exact pieces, odd below zero).

    Value and derivative are finite everywhere; values outside [0, 1] follow the same curve.
    """
    magnitude = jnp.abs(encoded)
    dark = magnitude <= 0.04045
    curve = ((jnp.where(dark, 1.0, magnitude) + 0.055) / 1.055) ** 2.4
    return jnp.where(dark, encoded / 12.92, jnp.sign(encoded) * curve)


@jax.jit
def linear_to_srgb(linear: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Encode linear light as sRGB (IEC 61966-2-1, exact pieces, odd below zero).

    Value and derivative are finite everywhere; values outside [0, 1] follow the same curve.
    """
    magnitude = jnp.abs(linear)
    dark = magnitude <= 0.0031308
    curve = 1.055 * jnp.where(dark, 1.0, magnitude) ** (1 / 2.4) - 0.055
    return jnp.where(dark, linear * 12.92, jnp.sign(linear) * curve)


def luminance(linear: Float[Array, "*shape 3"]) -> Float[Array, "*shape"]:
    """Relative luminance of linear RGB."""
    return linear @ jnp.asarray(LUMINANCE, linear.dtype)


def rgb_to_yiq(rgb: Float[Array, "*shape 3"]) -> Float[Array, "*shape 3"]:
    """Luma and the two chroma axes (orange-blue I, purple-green Q)."""
    return rgb @ jnp.asarray(RGB_TO_YIQ.T, rgb.dtype)


def yiq_to_rgb(yiq: Float[Array, "*shape 3"]) -> Float[Array, "*shape 3"]:
    """Inverse of ``rgb_to_yiq``."""
    return yiq @ jnp.asarray(YIQ_TO_RGB.T, yiq.dtype)
