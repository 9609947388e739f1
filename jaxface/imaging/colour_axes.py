"""A picture's own colour axes: the directions in which its colours vary, most first.

The principal axes of the pixels' colours (Heeger and Bergen 1995, "Pyramid-Based Texture Analysis/
Synthesis", section 3.5, decorrelate colours so). A grey picture has one, a tinted one too; axes
along which nothing is to be seen are left out.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Float
from jaxface.imaging.colour import RGB_TO_YIQ

VISIBLE = 1.5 / 255
"""standard deviation along an axis, of sRGB's range, below which it is left out"""

LARGEST_GAIN = 4.0
"""by which an axis is amplified at most, so that chroma of no more than noise stays faint"""


class ColourAxes(NamedTuple):
    """Axes of a picture's colours.

    Attributes:
        mean: colour of the picture.
        axes: orthonormal rows, by falling variance.
        gains: of each axis' channel; 1 for the first.
        levels: of each axis' channel where the colour is the mean.
    """

    mean: Float[Array, "c"]
    axes: Float[Array, "k c"]
    gains: Float[Array, "k"]
    levels: Float[Array, "k"]


def colour_axes(image: Float[Array, "h w c"]) -> ColourAxes:
    """The axes of a picture's colours (on the host).

    The first channel is an intensity: its mean is that of Y, and it rises with brightness. The
    others lie around 0.5 and are amplified to the first one's standard deviation, by
    ``LARGEST_GAIN`` at most.
    """
    pixels = np.asarray(image, np.float64).reshape(-1, image.shape[-1])
    mean = pixels.mean(axis=0)
    if len(mean) == 1:
        one = np.ones(1)
        return ColourAxes(*map(jnp.asarray, (mean, one[None], one, mean)))
    covariance = np.cov(pixels, rowvar=False, bias=True)
    variances, vectors = np.linalg.eigh(covariance)
    spread = np.sqrt(np.maximum(variances[::-1], 0))
    axes = vectors.T[::-1]
    axes = axes * np.where(axes.sum(axis=1) < 0, -1.0, 1.0)[:, None]
    kept = spread >= VISIBLE
    kept[0] = True
    spread, axes = spread[kept], axes[kept]
    # Along grey the channel would be sqrt(3) times the intensity.
    first = 1 / np.abs(axes[0]).sum()
    gains = np.minimum(first * spread[0] / np.maximum(spread, VISIBLE), first * LARGEST_GAIN)
    gains[0] = first
    levels = np.full(len(axes), 0.5)
    levels[0] = RGB_TO_YIQ[0] @ mean
    return ColourAxes(*map(jnp.asarray, (mean, axes, gains, levels)))


def to_channels(image: Float[Array, "h w c"], colours: ColourAxes) -> Float[Array, "h w k"]:
    """A picture's values along the axes."""
    along = jnp.einsum("hwc,kc->hwk", image - colours.mean, colours.axes)
    return along * colours.gains + colours.levels
