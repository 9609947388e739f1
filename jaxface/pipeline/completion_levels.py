"""Levels of a completion: textures at a lower resolution, steps, statistics that stay valid."""

import jax.numpy as jnp
import numpy as np
from scipy.ndimage import binary_fill_holes

from jaxface._types import Array, Bool, Float
from jaxface.stages.detail import soft_inside

OUTLINE = 24
"""part of a texture's side over which what is synthesised fades at the outline of the face"""


def fading(free: Bool[np.ndarray, "h w"], level: int) -> Float[Array, "h w"]:
    """How much of what is synthesised counts: 1, falling to 0 at the outline of the free texels.

    Slowly there, where blotches that end at once would show a seam; soon around eyes and mouth.

    Args:
        free: the texels that are synthesised.
        level: texels along a side of the whole texture.
    """
    outer = soft_inside(jnp.asarray(binary_fill_holes(free)), max(level // OUTLINE, 2))
    return outer * soft_inside(jnp.asarray(free), max(level // 128, 2))


def nearest_positive(gram: Float[Array, "n n"]) -> Array:
    """The nearest symmetric matrix without negative eigenvalues: differences may have some."""
    values, vectors = jnp.linalg.eigh((gram + gram.T) / 2)
    return (vectors * jnp.maximum(values, 0.0)) @ vectors.T


def level_steps(iterations: int, levels: int) -> list[int]:
    """Steps at each level, coarsest first: half as many at each finer one, one at least."""
    shares = 0.5 ** np.arange(levels)
    return [max(1, round(iterations * share)) for share in shares / shares.sum()]


def shrink(texture: Float[np.ndarray, "r r c"], side: int) -> Float[np.ndarray, "s s c"]:
    """Average over blocks of texels; a texture that is small enough already is left as it is."""
    factor = max(len(texture) // side, 1)
    if factor == 1:
        return np.asarray(texture, np.float32)
    blocks = np.asarray(texture, np.float32).reshape(side, factor, side, factor, -1)
    return blocks.mean(axis=(1, 3))
