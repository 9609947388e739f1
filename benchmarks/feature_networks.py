"""Which feature network's Gramians know a texture again: random, trained, VGG.

Rank-1 identification by the distance ``sum_l ||G^l - H^l|| / sqrt(||G^l|| ||H^l||)`` over the five
style layers, of pictures that no network was trained on:

- cheeks: which of K skins a left cheek belongs to, given all right ones, and the reverse;
- cheek and forehead: the same with other parts of the face;
- both also of the detail alone (less a Gaussian low pass, at middle grey), as the mean brightness
  already tells many skins apart and synthesis gets it from the low-frequency albedo;
- brick, grass, gravel: the nearest of all other 64 px patches is of the same picture.

    python benchmarks/feature_networks.py --real DIR [--vgg FILE] [--weights FILE ...]
"""

import argparse
import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from harness import Benchmark, Measurement
from scipy.ndimage import gaussian_filter
from skimage import data

from jaxface.imaging.colour import rgb_to_yiq
from jaxface.io.feature_weights import TRAINED, load_network
from jaxface.io.texture_database import TextureDatabase
from jaxface.networks.texture_features.network import STYLE_LAYERS, FeatureNetwork
from jaxface.networks.texture_features.random_weights import random_network
from jaxface.training.features import batch_grams, relative_distances

SIDE = 192
PLACES = {"left": (580, 224), "right": (580, 608), "forehead": (372, 416)}
"""upper left texel of a patch of the default model's 1024 texel albedo"""

LOW_PASS = 12.0
"""standard deviation, texels, of what detail is without"""


def skin_patches(folder: Path) -> dict[str, np.ndarray]:
    """Y of each place of all subjects, (K, SIDE, SIDE), and its detail alone."""
    database = TextureDatabase(folder)
    if database.resolution != 1024:
        raise ValueError(f"{folder} is at {database.resolution} texels; needed are 1024")
    found: dict[str, list[np.ndarray]] = {}
    for texture in database:
        y = np.asarray(rgb_to_yiq(jnp.asarray(texture))[..., 0])
        detail = np.clip(0.5 + y - gaussian_filter(y, LOW_PASS), 0, 1)
        for place, (row, column) in PLACES.items():
            window = slice(row, row + SIDE), slice(column, column + SIDE)
            found.setdefault(place, []).append(y[window])
            found.setdefault(f"{place} detail", []).append(detail[window])
    return {name: np.stack(patches) for name, patches in found.items()}


def material_patches(side: int = 64) -> tuple[np.ndarray, np.ndarray]:
    """Patches of three photographs of materials at equal mean and contrast, and which they show."""
    patches, labels = [], []
    for label, name in enumerate(("brick", "grass", "gravel")):
        picture = np.asarray(getattr(data, name)(), np.float32) / 255
        picture = np.clip(0.5 + 0.15 * (picture - picture.mean()) / picture.std(), 0, 1)
        count = picture.shape[0] // side
        grid = picture[: count * side, : count * side].reshape(count, side, count, side)
        patches.append(grid.transpose(0, 2, 1, 3).reshape(-1, side, side))
        labels += [label] * count**2
    return np.concatenate(patches), np.array(labels)


def all_grams(network: FeatureNetwork, images: np.ndarray) -> dict[str, jax.Array]:
    """Gramians of many images, a few at a time."""
    compute = jax.jit(partial(batch_grams, network))
    parts = [compute(jnp.asarray(images[i : i + 8])) for i in range(0, len(images), 8)]
    return {name: jnp.concatenate([part[name] for part in parts]) for name in parts[0]}


def distance(first: dict[str, jax.Array], second: dict[str, jax.Array]) -> np.ndarray:
    """By layer and in sum: (layers + 1, a, b)."""
    layers = [np.sqrt(np.maximum(relative_distances(first[n], second[n]), 0)) for n in first]
    return np.stack([*layers, np.sum(layers, axis=0)])


def rank1(distances: np.ndarray) -> np.ndarray:
    """Share of rows and columns whose least entry is on the diagonal."""
    own = np.arange(distances.shape[-1])
    return (np.mean(distances.argmin(-1) == own, -1) + np.mean(distances.argmin(-2) == own, -1)) / 2


def cropped(network: FeatureNetwork) -> FeatureNetwork:
    """Without the layers after the last style layer there is."""
    known = [name for name in network.layers if name in STYLE_LAYERS]
    keep = network.layers[: network.layers.index(known[-1]) + 1]
    return FeatureNetwork(
        {name: network.kernels[name] for name in keep},
        {name: network.biases[name] for name in keep},
        network.pooling,
        network.name,
    )


def measure(network: FeatureNetwork, skins: dict[str, np.ndarray]) -> dict[str, float]:
    """Every share, over all layers and for the best single one."""
    grams = {name: all_grams(network, patches) for name, patches in skins.items()}
    values = {}
    for kind in ("", " detail"):
        for title, one, other in (
            ("cheeks", "left", "right"),
            ("cheek and forehead", "left", "forehead"),
        ):
            shares = rank1(distance(grams[one + kind], grams[other + kind]))
            values[title + kind] = float(shares[-1])
            values[f"{title}{kind}, best layer"] = float(shares[:-1].max())
    patches, labels = material_patches()
    found = all_grams(network, patches)
    apart = distance(found, found)
    apart[:, np.arange(len(labels)), np.arange(len(labels))] = np.inf
    values["materials"] = float(np.mean(labels[apart.argmin(-1)] == labels, -1)[-1])
    return values


def main() -> None:
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--real", type=Path, required=True)
    parser.add_argument("--vgg", type=Path)
    parser.add_argument("--weights", type=Path, nargs="*", default=[])
    options, others = parser.parse_known_args()
    networks = {f"random, seed {seed}": random_network("compact", seed) for seed in range(3)}
    networks["random-vgg19"] = random_network("vgg19")
    for path in (TRAINED, *options.weights):
        if path.is_file():
            networks["trained" if path == TRAINED else path.stem] = load_network(path)
    if options.vgg is not None:
        networks["VGG-19 to conv3_1"] = load_network(options.vgg)
    skins = skin_patches(options.real)
    bench = Benchmark("feature_networks")
    for name, network in networks.items():
        start = time.perf_counter()
        values = {"skins": float(len(skins["left"])), **measure(cropped(network), skins)}
        bench.record(Measurement(name, best=time.perf_counter() - start, repeats=1, values=values))
        print(values, flush=True)
    bench.finish(others)


if __name__ == "__main__":
    main()
