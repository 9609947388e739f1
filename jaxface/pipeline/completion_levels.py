"""Levels of a completion: textures at a lower resolution, steps, statistics that stay valid."""

import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Float


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
