"""A whole low-frequency albedo from the model's and what the photo shows of it."""

from functools import partial

import jax
import jax.numpy as jnp

from jaxface._types import Array, Float, Int
from jaxface.geometry.uv import UVLayout
from jaxface.imaging.push_pull import push_pull


@partial(jax.jit, static_argnames=("cells",))
def low_frequency_albedo(
    albedo: Float[Array, "r r 3"],
    weight: Float[Array, "r r"],
    model_albedo: Float[Array, "n 3"],
    faces: Int[Array, "f 3"],
    layout: UVLayout,
    *,
    cells: int = 64,
) -> Float[Array, "r r 3"]:
    """The model's albedo times a smooth gain that makes it agree with the partial one.

    The model has a few modes (``I(alpha_al)`` of Saito 2017); the gain carries what they cannot say
    of complexion, measured in cells of the texture and continued smoothly over what is not seen.
    It holds no detail: the synthesis of section 5 adds that.

    Args:
        albedo: partial albedo, linear RGB.
        weight: how far each texel is to be trusted.
        model_albedo: albedo of each vertex, ``MorphableModel.reflectance``, linear RGB.
        faces: triangles of the vertices.
        layout: the texture's layout.
        cells: cells along a side of the texture in which the gain is measured.

    Returns:
        Linear RGB, the mean albedo in the empty space between the charts.
    """
    trust = weight[..., None]
    base = layout(model_albedo, faces)
    size = layout.resolution
    cell = -(-size // cells)
    extra = cell * cells - size

    def cell_sums(x: Array) -> Array:
        padded = jnp.pad(x, ((0, extra), (0, extra), (0, 0)))
        return jnp.sum(padded.reshape(cells, cell, cells, cell, -1), axis=(1, 3))

    known = cell_sums(trust) / cell**2
    observed, expected = cell_sums(trust * albedo), cell_sums(trust * base)
    # A specular or badly lit cell must not carry its colour over half the face.
    gain = jnp.clip(observed / jnp.maximum(expected, 1e-6), 1 / 3, 3.0)
    smooth = push_pull(jnp.log(gain), known[..., 0])
    whole = jax.image.resize(smooth, (cell * cells, cell * cells, 3), "linear")
    filled = base * jnp.exp(whole[:size, :size])
    empty = (layout.triangle < 0)[..., None]
    return jnp.where(empty, jnp.mean(model_albedo, axis=0), filled)


@jax.jit
def over_low_frequency(
    albedo: Float[Array, "r r 3"],
    weight: Float[Array, "r r"],
    low_frequency: Float[Array, "r r 3"],
) -> Float[Array, "r r 3"]:
    """A whole texture to look at: the partial albedo, by its weight, over the low-frequency one."""
    return weight[..., None] * albedo + (1 - weight[..., None]) * low_frequency
