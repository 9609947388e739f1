"""How far a texture is from the true one inside a mask: statistics, spectrum, patches, colour."""

from functools import cache, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import binary_erosion, gaussian_filter
from skimage.color import deltaE_cie76, rgb2lab

from jaxface._types import Array, Bool, Float
from jaxface.imaging.colour import rgb_to_yiq
from jaxface.io.feature_weights import load_network
from jaxface.networks.texture_features.network import STYLE_LAYERS, FeatureNetwork, features
from jaxface.networks.texture_features.random_weights import random_network

MEASURING_SEED = 4021
"""of the measuring network: no synthesis has seen it"""

OCTAVES = (2, 4, 8, 16, 32)
"""shortest wavelength of each octave, texels"""

PATCH, PATCHES, DIRECTIONS = 7, 6000, 128
SCALES = 3
LOW_PASS = 8.0
"""standard deviation, texels, of the colours that are compared"""


@cache
def measuring_networks(weights: Path | None) -> tuple[tuple[str, FeatureNetwork, tuple], ...]:
    """Name, network and layers of the networks that measure."""
    found = [("random", random_network("compact", seed=MEASURING_SEED), STYLE_LAYERS)]
    if weights is not None:
        found.append(("VGG-19", load_network(weights), STYLE_LAYERS[:3]))
    return tuple(found)


@partial(jax.jit, static_argnames=("layers",))
def inner_grams(
    network: FeatureNetwork, image: Float[Array, "h w"], mask: Bool[Array, "h w"], layers: tuple
) -> dict[str, Float[Array, "n n"]]:
    """Gramians over the pixels of a mask alone (the network sees the image beyond it, too)."""
    found = {}
    for name, responses in features(network, image, layers).items():
        factor = image.shape[0] // responses.shape[0]
        height, width = responses.shape[:2]
        blocks = mask[: height * factor, : width * factor]
        blocks = blocks.reshape(height, factor, width, factor)
        share = jnp.mean(blocks.astype(image.dtype), axis=(1, 3))
        found[name] = jnp.einsum("hw,hwi,hwj->ij", share, responses, responses) / jnp.sum(share)
    return found


def gram_distances(
    texture: Float[np.ndarray, "h w 3"],
    truth: Float[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    weights: Path | None,
) -> dict[str, float]:
    """``||G - G*|| / ||G*||`` by layer and their mean, for each measuring network."""
    where = jnp.asarray(mask)
    # Beyond the mask both are the truth, so that only what lies within is compared.
    joined = np.where(mask[..., None], texture, truth)
    images = [rgb_to_yiq(jnp.asarray(x))[..., 0] for x in (joined, truth)]
    values = {}
    for name, network, layers in measuring_networks(weights):
        mine, true = (inner_grams(network, image, where, layers) for image in images)
        relative = {
            layer: float(jnp.linalg.norm(mine[layer] - true[layer]) / jnp.linalg.norm(true[layer]))
            for layer in layers
        }
        values[f"Gram, {name}"] = float(np.mean(list(relative.values())))
        values.update({f"Gram, {name} {layer}": value for layer, value in relative.items()})
    return values


def masked_blur(
    image: Float[np.ndarray, "h w c"], mask: Bool[np.ndarray, "h w"], blur: float
) -> np.ndarray:
    """Gaussian blur of what lies within a mask, nothing from beyond it."""
    inside = mask[..., None].astype(np.float32)
    spread = (blur, blur, 0)
    return gaussian_filter(image * inside, spread) / np.maximum(
        gaussian_filter(inside, spread), 1e-4
    )


def octave_powers(
    texture: Float[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "o"]:
    """Mean square of the intensity's bands of an octave each, within a mask."""
    y = np.asarray(rgb_to_yiq(jnp.asarray(texture)))[..., :1]
    # A difference of Gaussians whose response peaks in the middle of the octave.
    blurs = [0.0] + [0.26 * wavelength for wavelength in OCTAVES[1:]] + [0.52 * OCTAVES[-1]]
    smooth = [y if blur == 0 else masked_blur(y, mask, blur) for blur in blurs]
    bands = [a - b for a, b in zip(smooth[:-1], smooth[1:], strict=True)]
    return np.array([np.mean(band[mask] ** 2) for band in bands])


def patch_distances(
    texture: Float[np.ndarray, "h w 3"],
    truth: Float[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    seed: int = 0,
) -> list[float]:
    """Sliced Wasserstein distance of 7x7 patches, at each level of a Laplacian pyramid.

    In units of the truth's standard deviation at that level, channel by channel (Karras et al.
    2018 measure generators this way).
    """
    generator = np.random.default_rng(seed)
    distances = []
    for scale in range(SCALES):
        blur = 1.0 * 2**scale
        lower = 0.0 if scale == 0 else 0.5 * blur
        levels = []
        for image in (texture, truth):
            upper = image if scale == 0 else masked_blur(image, mask, lower)
            levels.append(upper - masked_blur(image, mask, blur))
        step = 2**scale
        whole = binary_erosion(mask, np.ones((PATCH * step, PATCH * step)))
        rows, columns = np.nonzero(whole)
        chosen = generator.choice(len(rows), min(PATCHES, len(rows)), replace=False)
        offsets = (np.arange(PATCH) - PATCH // 2) * step
        at = rows[chosen, None, None] + offsets[:, None], columns[chosen, None, None] + offsets
        spread = levels[1][mask].std(axis=0)
        sets = [(level[at] / spread).reshape(len(chosen), -1) for level in levels]
        directions = generator.standard_normal((sets[0].shape[1], DIRECTIONS))
        directions /= np.linalg.norm(directions, axis=0)
        mine, true = (np.sort(patches @ directions, axis=0) for patches in sets)
        distances.append(float(np.mean(np.abs(mine - true))))
    return distances


def colour_error(
    texture: Float[np.ndarray, "h w 3"],
    truth: Float[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
) -> float:
    """Mean CIE 1976 difference of the low-pass colours."""
    lab = [rgb2lab(np.clip(masked_blur(x, mask, LOW_PASS), 0, 1)) for x in (texture, truth)]
    return float(np.mean(deltaE_cie76(*lab)[mask]))


def distances(
    texture: Float[np.ndarray, "h w 3"],
    truth: Float[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    weights: Path | None = None,
) -> dict[str, float]:
    """All of it; smaller is better everywhere."""
    rows, columns = np.nonzero(mask)
    margin = 16
    low = (np.array([rows.min(), columns.min()]) - margin).clip(0) // 16 * 16
    high = (np.array([rows.max(), columns.max()]) + 2 * margin) // 16 * 16
    box = slice(low[0], high[0]), slice(low[1], high[1])
    texture, truth, mask = texture[box], truth[box], mask[box]
    values = gram_distances(texture, truth, mask, weights)
    ratios = np.log2(octave_powers(texture, mask) / octave_powers(truth, mask))
    values["power (octaves)"] = float(np.mean(np.abs(ratios)))
    for wavelength, ratio in zip(OCTAVES, ratios, strict=True):
        values[f"log2 power {wavelength}-{2 * wavelength}"] = float(ratio)
    patches = patch_distances(texture, truth, mask)
    values["patches"] = float(np.mean(patches))
    for scale, value in enumerate(patches):
        values[f"patches 1/{2**scale}"] = value
    values["colour (dE)"] = colour_error(texture, truth, mask)
    return values
