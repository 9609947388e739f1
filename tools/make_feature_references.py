"""Make ``tests/data/features/``: small VGG files written by torch, and torch's responses.

Needs ``pip install torch safetensors``; torch is on the processor, in double precision where it
computes references. Nothing here comes from jaxface.

    python tools/make_feature_references.py tests/data/features [VGG19_KERAS.npz]

The networks are VGG-16 and VGG-19 as torchvision numbers them (``features.N``), with few channels
and seeded random weights. With the Keras-layout weights of VGG-19 (conv1_1 .. conv3_4) their
responses on a seeded picture are stored too: mean, mean square and sixteen values of each layer.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import nn

DEPTHS = {"vgg16": (2, 2, 3, 3, 3), "vgg19": (2, 2, 4, 4, 4)}
CHANNELS = (4, 6, 6, 8, 8)
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
SIZE = (35, 33)  # odd rows are dropped by pooling


def small_vgg(name: str, average: bool) -> nn.Sequential:
    """The convolutional part, numbered as torchvision's ``features``."""
    layers, channels = [], 3
    for count, width in zip(DEPTHS[name], CHANNELS, strict=True):
        for _ in range(count):
            layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
            channels = width
        layers.append(nn.AvgPool2d(2) if average else nn.MaxPool2d(2))
    return nn.Sequential(*layers)


def responses(network: nn.Sequential, x: torch.Tensor) -> dict[str, np.ndarray]:
    """Post-ReLU responses by layer, (h, w, n)."""
    found, block, place = {}, 1, 1
    for layer in network:
        x = layer(x)
        if isinstance(layer, nn.ReLU):
            found[f"conv{block}_{place}"] = x[0].permute(1, 2, 0).detach().numpy()
            place += 1
        elif not isinstance(layer, nn.Conv2d):
            block, place = block + 1, 1
    return found


def normalised(picture: np.ndarray) -> torch.Tensor:
    """Grey as three equal channels, as torchvision's networks want it."""
    grey = torch.from_numpy(picture)[None].repeat(3, 1, 1)
    shape = (3, 1, 1)
    return ((grey - torch.tensor(MEAN).reshape(shape)) / torch.tensor(STD).reshape(shape))[None]


def small_networks(folder: Path, picture: np.ndarray) -> dict[str, np.ndarray]:
    """Write the small networks in every container; return their responses."""
    arrays = {}
    for name in DEPTHS:
        torch.manual_seed(len(name) + DEPTHS[name][2])
        network = small_vgg(name, average=False)
        for parameter in network.parameters():
            parameter.data *= 2 if parameter.ndim > 1 else 1
        state = {f"features.{key}": value for key, value in network.state_dict().items()}
        state["classifier.0.weight"] = torch.zeros(2, 8)
        torch.save(state, folder / f"{name}_small.pth")
        save_file(state, folder / f"{name}_small.safetensors")
        legacy = folder / f"{name}_small_legacy.pth"
        torch.save(state, legacy, _use_new_zipfile_serialization=False)
        weights = network.state_dict()
        for pooling in ("max", "average"):
            double = small_vgg(name, pooling == "average").double()
            double.load_state_dict(weights)
            for layer, value in responses(double, normalised(picture)).items():
                arrays[f"{name}/{pooling}/{layer}"] = value.astype(np.float32)
    return arrays


def real_network(path: Path, picture: np.ndarray) -> dict[str, np.ndarray]:
    """Responses of the real VGG-19 up to conv3_4, summarised."""
    weights = np.load(path)
    network = nn.Sequential()
    channels = 3
    for block, count in enumerate((2, 2, 4), start=1):
        for index in range(1, count + 1):
            kernel = weights[f"block{block}_conv{index}.kernel"].astype(np.float64)
            layer = nn.Conv2d(channels, kernel.shape[3], 3, padding=1).double()
            layer.weight.data = torch.from_numpy(kernel.transpose(3, 2, 0, 1).copy())
            bias = weights[f"block{block}_conv{index}.bias"].astype(np.float64)
            layer.bias.data = torch.from_numpy(bias)
            network.extend([layer, nn.ReLU()])
            channels = kernel.shape[3]
        network.append(nn.AvgPool2d(2))
    bgr = torch.from_numpy(255 * picture)[None].repeat(3, 1, 1)
    bgr = bgr - torch.tensor((103.939, 116.779, 123.68), dtype=torch.float64).reshape(3, 1, 1)
    arrays = {}
    for layer, value in responses(network, bgr[None]).items():
        flat = value.ravel()
        places = np.random.default_rng(0).choice(flat.size, 16, replace=False)
        summary = np.concatenate([[flat.mean(), (flat**2).mean()], flat[places]])
        arrays[f"real/{layer}"] = summary
        arrays[f"real/{layer}/places"] = places
    return arrays


def main() -> None:
    """Write the files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", type=Path)
    parser.add_argument("vgg19_keras", type=Path, nargs="?")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    picture = np.random.default_rng(5).random(SIZE)
    arrays = {"picture": picture} | small_networks(arguments.output, picture)
    if arguments.vgg19_keras:
        arrays |= real_network(arguments.vgg19_keras, picture)
    np.savez_compressed(arguments.output / "references.npz", **arrays)
    for path in sorted(arguments.output.iterdir()):
        print(f"{path}: {path.stat().st_size} bytes")


if __name__ == "__main__":
    main()
