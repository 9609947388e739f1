"""Smooth filling of the holes of an image from what is known around them."""

import jax
import jax.numpy as jnp

from jaxface._types import Array, Float


def push_pull(values: Float[Array, "h w c"], weight: Float[Array, "h w"]) -> Float[Array, "h w c"]:
    """Keep values of weight 1, replace those of weight 0 by a smooth continuation of the rest.

    Gortler, Grzeszczuk, Szeliski and Cohen, "The Lumigraph", SIGGRAPH 1996, section 3.4: weighted
    averages are pulled up a pyramid, and pushed down again wherever a finer level knows less.
    Near a hole's rim the rim's values continue; far from it, the average of all that is known.
    Where nothing is known at all the result is 0. Linear in ``values``.
    """
    height, width = weight.shape
    known = jnp.clip(weight, 0.0, 1.0)[..., None]
    mean = values * known / jnp.maximum(known, 1e-12)
    if height == 1 and width == 1:
        return mean
    margin = ((0, height % 2), (0, width % 2), (0, 0))
    rows, columns = (height + 1) // 2, (width + 1) // 2

    def blocks(x: Array) -> Array:
        return jnp.sum(jnp.pad(x, margin).reshape(rows, 2, columns, 2, -1), axis=(1, 3))

    total = blocks(known)
    average = blocks(mean * known) / jnp.maximum(total, 1e-12)
    coarse = push_pull(average, jnp.minimum(total[..., 0], 1.0))
    finer = jax.image.resize(coarse, (2 * rows, 2 * columns, values.shape[-1]), "linear")
    return known * mean + (1 - known) * finer[:height, :width]
