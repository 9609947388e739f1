"""Colour of skin from its pigments: optical densities that absorb a base albedo.

Skin's diffuse reflectance is close to ``base * exp(-sum_k density_k * absorption_k)`` with two
pigments, melanin and haemoglobin (Tsumura et al., "Image-based skin color and texture analysis /
synthesis by extracting hemoglobin and melanin information in the skin", SIGGRAPH 2003). The
directions are those of diffuse reflectance, not of a thin layer: light that a pigment absorbs
strongly has travelled a shorter way, which draws the three channels together.
"""

import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Float

PIGMENTS = ("melanin", "haemoglobin", "shade")
"""rows of a density; "shade" is neutral: hair, shadow in a cavity"""

ABSORPTION = np.array(
    [
        [0.74, 1.00, 1.18],
        [0.24, 1.00, 0.80],
        [1.00, 1.00, 1.00],
    ],
    np.float32,
)
"""density in linear R, G, B of one unit of each pigment, relative to green"""


def absorb(base: Float[Array, "3 n"], density: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
    """Albedo of skin whose base albedo (linear RGB rows) gets pigment densities on top."""
    return base * jnp.exp(-jnp.einsum("kc,kn->cn", jnp.asarray(ABSORPTION), density))
