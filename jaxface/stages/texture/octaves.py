"""Detail with the strength that the photo shows, octave by octave.

Statistics are blended within the database's convex hull, and a few steps of synthesis do not change
the power of fine detail by much. How strong each octave is can be read off the photo at once, as
far as it resolves it: coarse skin gets detail amplified, smooth skin weakened.
"""

import jax
import jax.numpy as jnp

from jaxface._types import Array, Float
from jaxface.imaging.colour import rgb_to_yiq
from jaxface.imaging.low_pass import low_pass

OCTAVES = 4
"""from wavelengths of 2 to 4 texels on"""

HELD = 2.5
"""pixels of the photo to a wave that it holds, in the middle of an octave"""

WEAKEST, STRONGEST = 0.7, 2.0
"""bounds of the gain"""

AROUND = 1 / 16
"""standard deviation of the surroundings whose detail is compared, of the texture's side"""

PRIOR = 0.03
"""weight of the whole face in each surroundings"""


def octave_bands(intensity: Float[Array, "h w"], octaves: int = OCTAVES) -> Float[Array, "o h w"]:
    """Differences of Gaussians, each with its peak in the middle of an octave, finest first."""
    blurs = [0.26 * 4.0 * 2.0**k for k in range(octaves)]
    away = intensity - jnp.mean(intensity)
    smooth = [away, *(low_pass(away, blur) for blur in blurs)]
    return jnp.stack([fine - wide for fine, wide in zip(smooth[:-1], smooth[1:], strict=True)])


@jax.jit
def with_photos_octaves(
    texture: Float[Array, "r r 3"],
    photo: Float[Array, "r r 3"],
    weight: Float[Array, "r r"],
    pixel: Float[Array, ""] | float,
) -> Float[Array, "r r 3"]:
    """A texture whose octaves of detail are as strong as the photo's are in the same surroundings.

    The gain of an octave is the root of the ratio of mean squares, in a window where both are known
    and with the whole face as a prior; octaves that the photo does not resolve stay as they are.

    Args:
        texture: of a subject, sRGB-encoded.
        photo: sRGB-encoded, anything where ``weight`` is 0.
        weight: how far each texel of the photo is to be trusted.
        pixel: side of a pixel of the photo, texels.
    """
    side = texture.shape[0]
    block = next((b for b in (8, 4, 2) if side % b == 0 and side >= 32 * b), 1)
    own, other = (rgb_to_yiq(x)[..., 0] for x in (texture, photo))
    # Beyond what is seen both are the texture: the seen part's outline makes no detail.
    other = weight * other + (1 - weight) * own
    sure = jnp.where(weight > 0.9, weight, 0.0)
    mine, shown = octave_bands(own), octave_bands(other)

    def pooled(x: Array) -> Array:
        return x.reshape(side // block, block, side // block, block).mean(axis=(1, 3))

    change = jnp.zeros_like(own)
    for k in range(OCTAVES):
        powers = []
        for band in (shown[k], mine[k]):
            square = pooled(sure * band**2)
            local = low_pass(square, AROUND * side / block)
            powers.append(jnp.maximum(local, 0.0) + PRIOR * jnp.mean(square) + 1e-10)
        gain = jnp.clip(jnp.sqrt(powers[0] / powers[1]), WEAKEST, STRONGEST)
        held = 2.0 ** (k + 1.5) >= HELD * jnp.asarray(pixel)
        wide = jax.image.resize(gain, own.shape, "linear")
        change = change + held * (wide - 1) * mine[k]
    return jnp.clip(texture * (1 + change / jnp.maximum(own, 0.02))[..., None], 0.0, 1.0)
