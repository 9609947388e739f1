"""Terms that hold a synthesised texture to what is known: the photo, and the low frequencies.

Saito 2017 names as its limitation (section 7) that a mole may appear anywhere, whether it exists
or not. Where the photo shows the skin, it says where: up to the frequency that the photo holds.
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


def known_detail_energy(
    image: Float[Array, "h w"],
    known: KnownDetail,
    blur: Float[Array, ""] | float,
    photo_weight: Float[Array, ""] | float = 1.0,
    plain_weight: Float[Array, ""] | float = 1.0,
) -> Float[Array, ""]:
    """``b sum_p w_p (K (I - P))_p^2 + c sum_p (1 - d_p) (I - L)_p^2``.

    K is a Gaussian low-pass: the first term binds the frequencies that the photo holds and leaves
    those above to synthesis.

    Args:
        image: Y of the texture.
        known: photo P with weights w, low frequencies L, detail map d.
        blur: standard deviation of K, texels; 0 binds every frequency.
        photo_weight: b.
        plain_weight: c.
    """
    away = known.weight * (image - known.photo)
    held = jnp.sum(known.weight * low_pass(away, blur) ** 2)
    plain = jnp.sum((1.0 - known.detail) * (image - known.low_frequency) ** 2)
    return photo_weight * held + plain_weight * plain
