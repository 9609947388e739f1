"""A photo of a face without its gloss, as a texture of the skin alone needs it.

The specular peak is found in SUV space (``imaging.suv``) and cut where the fit shows skin.
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter

from jaxface._types import Array, Float
from jaxface.imaging.crop import Crop
from jaxface.imaging.masks import fill_polygon
from jaxface.imaging.suv import remove_specular_peak
from jaxface.models.landmark_schemes import LIPS_OUTER

LIP_MARGIN = 0.008
"""of the working image's side, by which lips are taken to be wider than their outline"""

_specular_program = jax.jit(remove_specular_peak)


def lips(points: Float[np.ndarray, "l 2"], size: int) -> Float[np.ndarray, "s s"]:
    """Where the lips are, 0 to 1.

    They are redder than any skin beside them: what little they have of the source's colour would
    be taken for gloss, and they for darker than they are.

    Args:
        points: the 68 or 468 landmarks, pixels of the working image.
        size: its side, px.
    """
    outline = points[list(LIPS_OUTER)] if len(points) == 468 else points[48:60]
    inside = np.asarray(fill_polygon(jnp.asarray(outline, jnp.float32), size, size), np.float32)
    grown = maximum_filter(inside, size=2 * round(LIP_MARGIN * size) + 1)
    return gaussian_filter(grown, LIP_MARGIN * size)


def without_specularity(
    linear: Float[np.ndarray, "h w 3"],
    crop: Crop,
    skin: Float[np.ndarray, "s s"],
    light: Float[Array, "9 3"],
) -> Float[np.ndarray, "h w 3"]:
    """The photo with the specular peak of the face's skin cut, in the fitted light's colour.

    Args:
        linear: the photo, linear RGB.
        crop: where the face lies in it.
        skin: which pixels of the crop show skin, 0 to 1.
        light: of the fit, shading coefficients.
    """
    height, width = linear.shape[:2]
    low = np.floor(np.maximum(crop.origin, 0)).astype(int)
    high = np.ceil(np.minimum(crop.origin + crop.side, [width, height])).astype(int)
    cut = linear[low[1] : high[1], low[0] : high[0]]
    # Photos of similar size share a program.
    fill = [(0, -n % 64) for n in cut.shape[:2]]
    rows, columns = (np.arange(n + extra[1]) for n, extra in zip(cut.shape[:2], fill, strict=True))
    at = [
        np.clip(((line + 0.5 + low[axis] - crop.origin[axis]) / crop.side * len(skin)).astype(int),
                0, len(skin) - 1)
        for line, axis in ((rows, 1), (columns, 0))
    ]  # fmt: skip
    mask = skin[np.ix_(*at)]
    mask[cut.shape[0] :] = 0
    mask[:, cut.shape[1] :] = 0
    padded = np.pad(cut, (*fill, (0, 0)), mode="edge")
    colour = jnp.maximum(light[0] / jnp.maximum(jnp.max(light[0]), 1e-6), 0.1)
    diffuse = np.asarray(_specular_program(jnp.asarray(padded), colour, jnp.asarray(mask)))
    result = linear.copy()
    result[low[1] : high[1], low[0] : high[0]] = diffuse[: cut.shape[0], : cut.shape[1]]
    return np.maximum(result, 0.0)
