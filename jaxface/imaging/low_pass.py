"""Gaussian low-pass of any width, by its transfer function."""

import jax.numpy as jnp

from jaxface._types import Array, Float


def low_pass(image: Float[Array, "h w"], blur: Float[Array, ""] | float) -> Float[Array, "h w"]:
    """Gaussian blur by a standard deviation that may be traced; zeros beyond the border.

    Two runs along each axis of a box filter would tie the kernel to whole texels; the exact
    transfer function ``exp(-2 pi^2 f^2 s^2)`` is applied to the padded image's spectrum instead.
    """
    height, width = image.shape
    margin = 16
    padded = jnp.pad(image, ((0, margin), (0, margin)))
    spectrum = jnp.fft.rfft2(padded)
    fy = jnp.fft.fftfreq(height + margin).astype(image.dtype)[:, None]
    fx = jnp.fft.rfftfreq(width + margin).astype(image.dtype)[None]
    transfer = jnp.exp(-2 * jnp.pi**2 * (fy**2 + fx**2) * jnp.asarray(blur, image.dtype) ** 2)
    return jnp.fft.irfft2(spectrum * transfer, padded.shape)[:height, :width].astype(image.dtype)
