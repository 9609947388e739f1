"""Statistics of a photo's skin and of a database's, as section 4 of Saito 2017 compares them."""

import functools
from collections.abc import Iterable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Bool, Float
from jaxface.energies._gram import grams, mask_out
from jaxface.imaging.colour import rgb_to_yiq
from jaxface.imaging.resample import resize
from jaxface.networks.texture_features.network import FeatureNetwork
from jaxface.networks.texture_features.tiles import even_tile
from jaxface.stages.texture.detail import COMPLEXION, with_complexion, without_marks
from jaxface.stages.texture.octaves import with_photos_octaves
from jaxface.stages.texture.seen_level import SeenLevel

LARGEST_GAIN = 3.0
"""by which what a small part of the face shows is taken to hold for the whole"""

LARGEST_WHOLE = 1 << 20
"""texels up to which statistics are taken in one piece; beyond, in tiles"""

Departure = tuple[Mapping[str, Array], Mapping[str, Array] | None]
"""a subject's statistics, and those with what the photo shows, by layer"""

_grams = functools.partial(jax.jit, static_argnames=("layers", "tile"))(grams)


def box_tile(height: int, width: int) -> int | None:
    """Side of the tiles in which statistics are summed; None for the whole in one piece."""
    return even_tile((height, width)) if height * width > LARGEST_WHOLE else None


def masked_statistics(
    network: FeatureNetwork,
    texture: Float[Array, "r r 3"],
    mask: Bool[np.ndarray, "r r"],
    box: tuple[slice, slice],
    layers: tuple[str, ...],
) -> dict[str, Float[Array, "n n"]]:
    """Gram matrices ``G^l(M(I))`` of a texture's Y, masked out beyond a mask, in a box.

    Args:
        network: the weights.
        texture: sRGB-encoded.
        mask: true where visible.
        box: rows and columns that the network sees.
        layers: their names.
    """
    shown = mask_out(rgb_to_yiq(texture)[..., 0], jnp.asarray(mask))[box]
    return _grams(shown, network, layers=layers, tile=box_tile(*shown.shape))


def subject_texture(
    texture: Float[np.ndarray, "s s 3"],
    seen: SeenLevel,
    match_complexion: bool = True,
    match_octaves: bool = True,
) -> Float[Array, "r r 3"]:
    """A subject's texture at a level, on the photo's complexion and with detail as strong as its.

    Args:
        texture: sRGB-encoded, of the level's size or smaller.
        seen: what the photo shows.
        match_complexion: whether the subject's detail goes on the photo's complexion; else it is
            as it is.
        match_octaves: whether each octave then gets the photo's strength (`with_photos_octaves`).
    """
    own = jnp.asarray(texture)
    if len(texture) < seen.side:
        own = resize(own, seen.side, seen.side)
    if not match_complexion:
        return own
    blur = seen.side * COMPLEXION
    own = with_complexion(without_marks(own, seen.plain, blur), seen.low_frequency, blur)
    if not match_octaves:
        return own
    return with_photos_octaves(own, seen.photo, seen.weight * seen.mask, seen.texels_per_pixel)


def carried_gain(seen: SeenLevel, carry: float) -> float:
    """What the seen skin's departure counts: 1, or as if the whole face departed like it.

    Args:
        seen: what the photo shows.
        carry: 1 for the latter, 0 for the former.
    """
    weight = np.asarray(seen.weight)[seen.mask]
    return 1 + carry * min(1 / max(float(weight.mean()), 1e-3) - 1, LARGEST_GAIN - 1)


def kept_weights(weights: Float[np.ndarray, "k"], used: Sequence[int]) -> Float[np.ndarray, "u"]:
    """The weights of the subjects used, scaled so that their sum is that of all."""
    return weights[list(used)] * (weights.sum() / weights[list(used)].sum())


def target_statistics(
    shares: Float[np.ndarray, "u"], found: Iterable[Departure], gain: float
) -> dict[str, Float[Array, "n n"]]:
    """``sum_k w_k (G_k + g (G'_k - G_k))``, the nearest matrices that are Gram matrices.

    Args:
        shares: w_k.
        found: for each subject G_k of its texture, and G'_k of the same with what the photo shows
            in it, or None for none.
        gain: g, see `carried_gain`.
    """
    total: dict[str, Array] = {}
    for share, (plain, own) in zip(shares, found, strict=True):
        for name, value in plain.items():
            moved = value if own is None else value + gain * (own[name] - value)
            total[name] = share * moved + total.get(name, 0.0)
    return {name: nearest_positive(value) for name, value in total.items()}


def nearest_positive(gram: Float[Array, "n n"]) -> Array:
    """The nearest symmetric matrix without negative eigenvalues: differences may have some."""
    values, vectors = jnp.linalg.eigh((gram + gram.T) / 2)
    return (vectors * jnp.maximum(values, 0.0)) @ vectors.T
