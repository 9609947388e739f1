"""Colour of skin from its pigments: optical densities that absorb a base albedo.

Skin's diffuse reflectance is close to ``base * exp(-sum_k density_k * absorption_k)`` with two
pigments, melanin and haemoglobin (Tsumura et al., "Image-based skin color and texture analysis /
synthesis by extracting hemoglobin and melanin information in the skin", SIGGRAPH 2003). The
directions are those of diffuse reflectance, not of a thin layer: light that a pigment absorbs
strongly has travelled a shorter way, which draws the three channels together.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxface.models.skin.rows import Row, Vector

ABSORPTION = np.array([[0.74, 1.00, 1.18], [0.24, 1.00, 0.80], [1.00, 1.00, 1.00]], np.float32)
"""density in linear R, G, B of one unit of each pigment, relative to green"""


class Density(NamedTuple):
    """Optical densities in green, one number a texel."""

    melanin: Row | float = 0.0
    haemoglobin: Row | float = 0.0
    shade: Row | float = 0.0
    """neutral: hair, shadow in a cavity"""

    def plus(self, *others: "Density") -> "Density":
        """The sum of several densities."""
        rows = zip(self, *others, strict=True)
        return Density(*(sum(row[1:], start=row[0]) for row in rows))

    def times(self, factor: Row | float) -> "Density":
        """Every pigment scaled alike."""
        return Density(*(row * factor for row in self))


def absorb(base: Vector, density: Density) -> Vector:
    """Albedo of skin whose base albedo (linear R, G, B) gets pigment densities on top."""
    r, g, b = (
        channel * jnp.exp(-sum(row * float(k) for row, k in zip(density, weights, strict=True)))
        for channel, weights in zip(base, ABSORPTION.T, strict=True)
    )
    return r, g, b
