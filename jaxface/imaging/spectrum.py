"""Filters that act on an image's spatial frequencies."""

import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Float


def inverse_frequency(image: Float[Array, "h w"], offset: float = 8.0) -> Float[Array, "h w"]:
    """Each spatial frequency f scaled by ``1 / (f + f_0)``, periodically beyond the borders.

    White noise keeps its variance. Linear and symmetric.

    Args:
        image: values.
        offset: ``f_0`` in cycles over the longer side.
    """
    height, width = image.shape
    rows, columns = np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width)[None]
    scale = 1.0 / (np.hypot(rows, columns) + offset / max(height, width))
    scale = scale[:, : width // 2 + 1] / np.sqrt(np.mean(scale**2))
    spectrum = jnp.fft.rfft2(image) * jnp.asarray(scale, image.dtype)
    return jnp.fft.irfft2(spectrum, (height, width))
