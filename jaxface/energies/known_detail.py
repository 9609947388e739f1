"""Terms that hold a synthesised texture to what is known: the photo, and the low frequencies.

Saito 2017 names as its limitation (section 7) that a mole may appear anywhere, whether it exists
or not. Where the photo shows the skin, it says where: up to the frequency that the photo holds.

Both are sums of squares that are given as scalars, because their maps weigh each texel: a residual
would hold the root of a weight, whose derivative at 0, where most maps begin, does not exist.
"""

import equinox as eqx
import jax.numpy as jnp

from jaxface._types import Array, Float
from jaxface.imaging.low_pass import low_pass


class KnownDetail(eqx.Module):
    """What a texture is held to; every map (h, w), intensities as the texture's."""

    photo: Float[Array, "h w"]
    """what the photo shows, anything where ``weight`` is 0"""
    weight: Float[Array, "h w"]
    """how far the photo is to be trusted, 0 to 1"""
    low_frequency: Float[Array, "h w"]
    detail: Float[Array, "h w"]
    """where detail may go: 1 anywhere, 0 keeps the low frequencies as they are"""
    blur: Float[Array, ""] | float
    """standard deviation (texels) of the low-pass beyond which the photo holds nothing"""


def photo_detail_energy(image: Float[Array, "h w"], known: KnownDetail) -> Float[Array, ""]:
    """``sum_p w_p (K (w (I - P)))_p^2``: the photo, up to the frequency that it holds.

    K is a Gaussian low-pass of deviation ``known.blur``; frequencies above it are left to
    synthesis. A blur of 0 binds every frequency.

    Args:
        image: Y of the texture, I.
        known: photo P, weights w and the blur of K.
    """
    away = known.weight * (image - known.photo)
    return jnp.sum(known.weight * low_pass(away, known.blur) ** 2)


def plain_detail_energy(image: Float[Array, "h w"], known: KnownDetail) -> Float[Array, ""]:
    """``sum_p (1 - d_p) (I - L)_p^2``: the low frequencies, where no detail belongs.

    Args:
        image: Y of the texture, I.
        known: low frequencies L and the map d of where detail may go.
    """
    return jnp.sum((1.0 - known.detail) * (image - known.low_frequency) ** 2)
