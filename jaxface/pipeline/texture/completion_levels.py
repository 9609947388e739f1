"""Levels of a completion: textures at a lower resolution, steps, statistics that stay valid."""

import jax.numpy as jnp
import numpy as np
from scipy.ndimage import binary_fill_holes

from jaxface._types import Array, Bool, Float
from jaxface.imaging.low_pass import low_pass
from jaxface.stages.texture.detail import soft_inside

OUTLINE = 48
"""part of a texture's side over which synthesised blotches fade at the outline of the face"""

COMPLEXION = 64
"""part of a texture's side, standard deviation of the low-pass that is the complexion's"""

BLOTCHES = 192
"""part of a texture's side, standard deviation of the low-pass that tells them from pores"""


def faded(
    change: Float[Array, "h w"], free: Bool[np.ndarray, "h w"], level: int
) -> Float[Array, "h w"]:
    """What the synthesis changed, falling to 0 towards the texels that it left alone.

    Not of the complexion, which the low frequencies and the photo give, and a Gramian moves freely.
    At the outline of the free texels blotches fade slowly, for where they end at once they show a
    seam, and pores soon, as both do around eyes and mouth (after Burt and Adelson, "A
    multiresolution spline", 1983).

    Args:
        change: of the intensity.
        free: the texels that were synthesised.
        level: texels along a side of the whole texture.
    """
    outline = soft_inside(jnp.asarray(binary_fill_holes(free)), max(level // OUTLINE, 2))
    rim = soft_inside(jnp.asarray(free), max(level // 128, 2))
    change = jnp.where(free, change, 0)
    change = change - jnp.where(free, low_pass(change, level / COMPLEXION), 0)
    blotches = low_pass(change, level / BLOTCHES)
    return rim * (change - (1 - outline) * blotches)


def nearest_positive(gram: Float[Array, "n n"]) -> Array:
    """The nearest symmetric matrix without negative eigenvalues: differences may have some."""
    values, vectors = jnp.linalg.eigh((gram + gram.T) / 2)
    return (vectors * jnp.maximum(values, 0.0)) @ vectors.T


def level_steps(iterations: int, levels: int) -> list[int]:
    """Steps at each level, coarsest first: half as many at each finer one, one at least."""
    shares = 0.5 ** np.arange(levels)
    return [max(1, round(iterations * share)) for share in shares / shares.sum()]
