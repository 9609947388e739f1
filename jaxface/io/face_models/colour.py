"""Texture statistics in sRGB, as most models store them, turned into linear-light albedo."""

import numpy as np

from jaxface._types import Float
from jaxface.io.face_models.assemble import Modes


def linear_albedo(
    mean: Float[np.ndarray, "n 3"],
    basis: Float[np.ndarray, "n 3 k"],
    std: Float[np.ndarray, "k"],
) -> tuple[Float[np.ndarray, "n 3"], Modes]:
    """Linear-light mean and modes of a linear model over sRGB values in [0, 1].

    The sRGB curve ``f`` bends, so a linear model over sRGB is none over linear light. The mean is
    decoded exactly, the modes to first order: ``f(m + B z) = f(m) + f'(m) B z + O(z^2)``.

    Args:
        mean: sRGB per vertex, in [0, 1].
        basis: orthonormal modes over sRGB values.
        std: their standard deviations, in the same units.
    """
    encoded = np.clip(np.asarray(mean, np.float64), 0.0, 1.0)
    dark = encoded <= 0.04045
    root = (np.maximum(encoded, 0.04045) + 0.055) / 1.055
    decoded = np.where(dark, encoded / 12.92, root**2.4)
    slope = np.where(dark, 1 / 12.92, 2.4 / 1.055 * root**1.4)
    std = np.asarray(std, np.float64)
    return decoded, Modes(basis * (slope[..., None] * std).astype(basis.dtype), std)
