"""VGG-like feature extractor (Saito 2017, section 4; Simonyan and Zisserman 2015).

Blocks of 3x3 convolutions with ReLU, each block after the first behind a 2x2 pooling. The input is
one channel, the Y of YIQ of a gamma-encoded texture; a network made for colour sees it as grey.
"""

import dataclasses
import re
from collections.abc import Iterable, Sequence

import equinox as eqx
import jax.numpy as jnp
from jax import lax

from jaxface._types import Array, Bool, Float
from jaxface.networks.convolution.conv3x3 import Prepared, conv3x3_relu, prepared_kernel

STYLE_LAYERS = ("conv1_1", "conv2_1", "conv3_1", "conv4_1", "conv5_1")
"""the layers whose correlations describe detail: the first of each block"""

POOLINGS = ("average", "max")


class FeatureNetwork(eqx.Module):
    """Kernels (HWIO) and biases by layer name, ``convB_I`` for the I-th convolution of block B.

    The first kernel has two input channels: the image, and an indicator that is 1 inside the
    image and 0 outside. The second carries what a network subtracts from its input, so that the
    zeros around the image are zeros *after* the subtraction, as in training, exactly.
    """

    kernels: dict[str, Float[Array, "3 3 _ _"]]
    biases: dict[str, Float[Array, "_"]]
    pooling: str = eqx.field(static=True, default="average")
    """``average`` (Gatys et al. 2015: smoother gradients) or ``max``"""
    name: str = eqx.field(static=True, default="network")
    licence: str = eqx.field(static=True, default="")
    """one line: licence and credit of the weights"""
    prepared: dict[str, Prepared] = eqx.field(default_factory=dict)
    """by layer, what convolutions make of its kernel, where that is kept (``prepare_kernels``)"""

    def __check_init__(self):
        if self.pooling not in POOLINGS:
            raise ValueError(f"pooling is {self.pooling!r}; needed is one of {POOLINGS}")
        if sorted(self.kernels) != sorted(self.biases):
            raise ValueError("kernels and biases must have the same layers")

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the layers, from the image on."""
        return tuple(sorted(self.kernels, key=layer_position))

    @property
    def channels(self) -> dict[str, int]:
        """Number of responses n of each layer."""
        return {name: self.kernels[name].shape[3] for name in self.layers}


def prepare_kernels(network: FeatureNetwork, shape: tuple[int, int]) -> FeatureNetwork:
    """The network with what convolutions make of its kernels, for many images of one small shape.

    Made anew for each image, they are a tenth of an evaluation of VGG-19 at 256 px; kept they take
    eight times as much memory as the kernels of the layers that have any: 335 MB there. Tiles do
    without. A network that is prepared must not be trained: ``prepared`` stays as it is.

    Args:
        network: the weights.
        shape: height and width of the images, px.
    """

    def pixels(name: str) -> int:
        block = layer_position(name)[0] - 1
        return (shape[0] >> block) * (shape[1] >> block)

    made = {name: prepared_kernel(k, pixels(name)) for name, k in network.kernels.items()}
    kept = {name: both for name, both in made.items() if both}
    return dataclasses.replace(network, prepared=kept)


def layer_position(name: str) -> tuple[int, int]:
    """Block and place in it, both from 1.

    Raises:
        ValueError: the name is not of the form ``convB_I``.
    """
    match = re.fullmatch(r"conv([1-9])_([1-9]\d?)", name)
    if match is None:
        raise ValueError(f"layer {name!r} is not of the form 'conv3_1' (block 3, convolution 1)")
    return int(match[1]), int(match[2])


def blocks_up_to(network: FeatureNetwork, layers: Iterable[str]) -> list[tuple[str, ...]]:
    """Names of all layers that have to be computed, by block, to reach the given ones.

    Raises:
        ValueError: no layer is asked for, or the network lacks one.
    """
    layers = tuple(layers)
    if not layers:
        raise ValueError("no layer is asked for")
    missing = [name for name in layers if name not in network.kernels]
    if missing:
        known = network.layers
        raise ValueError(
            f"network {network.name!r} has no weights for {', '.join(missing)}; it has "
            f"{known[0]} .. {known[-1]}" + (f" ({', '.join(known)})" if len(known) < 20 else "")
        )
    last = max(map(layer_position, layers))
    needed = [name for name in network.layers if layer_position(name) <= last]
    return [
        tuple(name for name in needed if layer_position(name)[0] == block)
        for block in range(1, last[0] + 1)
    ]


def features(
    network: FeatureNetwork,
    image: Float[Array, "h w"],
    layers: Sequence[str] = STYLE_LAYERS,
    method: str = "auto",
) -> dict[str, Float[Array, "_ _ _"]]:
    """Responses F^l(I) after the ReLU of the layers asked for.

    Differentiable in both modes, to any order, and mappable.

    Args:
        network: the weights.
        image: Y of the gamma-encoded texture in [0, 1], row 0 at the top.
        layers: names, in any order.
        method: how convolutions are computed, see ``conv3x3.METHODS``.

    Returns:
        For each layer a map of ``h // 2**(block - 1)`` rows.

    Raises:
        ValueError: a layer is unknown or its map would be empty, or the image is not (h, w).
    """
    blocks = blocks_up_to(network, layers)
    if image.ndim != 2:
        raise ValueError(f"image has shape {image.shape}; needed is one channel, (h, w)")
    if min(image.shape) < 2 ** (len(blocks) - 1):
        raise ValueError(
            f"an image of {image.shape[0]}x{image.shape[1]} pixels has no {blocks[-1][-1]}; needed "
            f"are at least {2 ** (len(blocks) - 1)} rows and columns"
        )
    x = with_indicator(image)
    wanted = {}
    for index, block in enumerate(blocks):
        x = pool(x, network.pooling) if index else x
        for name in block:
            kernel, bias = network.kernels[name], network.biases[name]
            x = conv3x3_relu(x, kernel, bias, method, network.prepared.get(name, ()))
            if name in layers:
                wanted[name] = x
    return {name: wanted[name] for name in layers}


def with_indicator(
    image: Float[Array, "h w"], inside: Bool[Array, "h w"] | None = None
) -> Float[Array, "h w 2"]:
    """The network's input: the image, and 1 where it is inside the image (everywhere if None)."""
    ones = jnp.ones_like(image) if inside is None else inside.astype(image.dtype)
    return jnp.stack([image, ones], axis=-1)


def pool(x: Float[Array, "h w n"], pooling: str = "average") -> Float[Array, "h2 w2 n"]:
    """Average or maximum of 2x2 cells; an odd last row or column is dropped, as in VGG."""
    height, width, _ = x.shape
    x = x[: height // 2 * 2, : width // 2 * 2]
    if pooling == "max":
        return lax.reduce_window(x, -jnp.inf, lax.max, (2, 2, 1), (2, 2, 1), "VALID")
    return (x[::2, ::2] + x[1::2, ::2] + x[::2, 1::2] + x[1::2, 1::2]) / 4
