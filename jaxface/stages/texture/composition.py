"""Textures put together: what a synthesis starts from, and what it changed in its surroundings."""

import jax.numpy as jnp
import numpy as np
from scipy.ndimage import binary_fill_holes

from jaxface._types import Array, Bool, Float
from jaxface.energies.known_detail import KnownDetail
from jaxface.imaging.colour import rgb_to_yiq, yiq_to_rgb
from jaxface.imaging.low_pass import low_pass
from jaxface.imaging.push_pull import push_pull
from jaxface.imaging.resample import resize
from jaxface.stages.texture.detail import soft_inside, with_intensity, with_photo
from jaxface.stages.texture.seen_level import SeenLevel

PHOTO_BLUR = 0.6
"""standard deviation of the low-pass that passes what a photo holds, in its pixels"""

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


def with_seen(texture: Float[Array, "r r 3"], seen: SeenLevel) -> Float[Array, "r r 3"]:
    """A texture with the frequencies that the photo holds, where it is seen."""
    return with_photo(texture, seen.photo, seen.weight, PHOTO_BLUR * seen.texels_per_pixel)


def start_texture(
    seen: SeenLevel,
    subject: Float[Array, "r r 3"] | None,
    detail: Float[Array, "r r"],
    skin: Float[np.ndarray, "r r 1"],
    keep_photo: bool = True,
) -> Float[np.ndarray, "r r 3"]:
    """The texture before synthesis: whole, sRGB-encoded.

    Args:
        seen: what the photo shows.
        subject: texture whose detail is let in; None: the low frequencies alone, as in the paper.
        detail: how much of it, 0 to 1.
        skin: 1 where it may go.
        keep_photo: whether it shows what the photo shows.
    """
    low = texture = seen.low_frequency
    if subject is not None:
        texture = low + detail[..., None] * (subject - low)
    if keep_photo:
        texture = with_seen(texture, seen)
    return np.asarray(skin * texture + (1 - skin) * low)


def first_intensity(
    start: Float[np.ndarray, "h w 3"], coarser: Float[np.ndarray, "a b"]
) -> Float[Array, "h w"]:
    """Y of a start, with the frequencies that a coarser level's result holds from there.

    Args:
        start: sRGB-encoded.
        coarser: that level's Y; empty at the first level.
    """
    first = rgb_to_yiq(jnp.asarray(start))[..., 0]
    if not coarser.size:
        return first
    lower = resize(first[..., None], *coarser.shape)
    return first + resize(jnp.asarray(coarser)[..., None] - lower, *first.shape)[..., 0]


def known_detail(
    seen: SeenLevel, detail: Float[Array, "r r"], box: tuple[slice, slice]
) -> KnownDetail:
    """What a synthesis in a box is held to."""
    return KnownDetail(
        rgb_to_yiq(seen.photo)[..., 0][box],
        seen.weight[box] * seen.mask[box],
        rgb_to_yiq(seen.low_frequency)[..., 0][box],
        detail[box],
        jnp.asarray(PHOTO_BLUR * seen.texels_per_pixel, seen.photo.dtype),
    )


def composed(
    start: Float[np.ndarray, "r r 3"],
    intensity: Float[np.ndarray, "h w"],
    box: tuple[slice, slice],
    free: Bool[np.ndarray, "r r"],
    inside: Float[np.ndarray, "r r 1"],
    fade: bool = True,
) -> Float[np.ndarray, "r r 3"]:
    """The synthesised intensity with the start's colour, in the start's surroundings.

    Args:
        start: whole texture, sRGB-encoded.
        intensity: synthesised Y in the box.
        box: its rows and columns.
        free: texels that were synthesised.
        inside: 1 in the charts.
        fade: towards the surroundings, chroma scaled with the intensity; False: as in the paper, Y
            as it is with I and Q of the start.
    """
    level = len(start)
    colour = jnp.asarray(start[box])
    yiq = rgb_to_yiq(colour)
    whole = np.array(start)
    if fade:
        change = jnp.asarray(intensity) - yiq[..., 0]
        mixed = yiq[..., 0] + faded(change, free[box], level)
        whole[box] = np.asarray(with_intensity(colour, mixed))
    else:
        own = jnp.concatenate([jnp.asarray(intensity)[..., None], yiq[..., 1:]], axis=-1)
        whole[box] = np.asarray(jnp.clip(yiq_to_rgb(own), 0, 1))
    # Between the charts the nearest colours continue, so that a filter finds no dark rim.
    return np.asarray(push_pull(jnp.asarray(whole), jnp.asarray(inside[..., 0] > 0.99, float)))
