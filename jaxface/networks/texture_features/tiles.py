"""Sums over an image's feature responses, tile by tile, in memory that the tile bounds.

Each tile is computed from a window that is larger by the receptive field; what the window's own
edges disturb is cut off block by block, and responses outside the image are set to zero after
every layer, as zero padding has it. So the responses are those of the whole image.

The sum is linear in what each tile adds, and each tile but the last is rematerialised: reverse mode
visits these twice, once for the sums and once, with the sums' cotangent known, for the gradient.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxface._types import Array, Bool, Float, Int, PyTree
from jaxface.networks.convolution.conv3x3 import conv3x3_relu
from jaxface.networks.texture_features.network import (
    STYLE_LAYERS,
    FeatureNetwork,
    blocks_up_to,
    layer_position,
    pool,
    with_indicator,
)

LARGEST_TILE = 1024
"""px; with VGG-19 to conv5_1 a tile of this size takes about 1.7 GB for loss and gradient"""


def even_tile(shape: tuple[int, int], largest: int = LARGEST_TILE) -> int:
    """Side of the tiles, at most ``largest``, that cover an image (h, w) with the least overhang.

    A multiple of 16, which suits every layer up to block 5.
    """
    count = -(-max(shape) // largest)
    return -(-max(shape) // (16 * count)) * 16


class Tiling(NamedTuple):
    """How an image is cut for a network; pixels of the image unless a block is named."""

    tile: int
    rows: int
    columns: int
    blocks: tuple[tuple[str, ...], ...]
    halos: tuple[int, ...]
    """of each block: pixels of that block that its window has around the tile"""


def tiling(
    network: FeatureNetwork, shape: tuple[int, int], layers: Sequence[str], tile: int
) -> Tiling:
    """Cut an image of a shape (height, width) into tiles for some layers.

    Raises:
        ValueError: a layer is unknown, or ``tile`` is no positive multiple of the last block's
            pixel (``2**(blocks - 1)``).
    """
    blocks = tuple(blocks_up_to(network, layers))
    pixel = 2 ** (len(blocks) - 1)
    if tile < 1 or tile % pixel:
        raise ValueError(
            f"tile is {tile}; needed is a positive multiple of {pixel}, a pixel of {blocks[-1][0]}"
        )
    halos = [0] * len(blocks)
    inner = 0
    for block in reversed(range(len(blocks))):
        halos[block] = inner + len(blocks[block])
        inner = 2 * halos[block]
    return Tiling(tile, -(-shape[0] // tile), -(-shape[1] // tile), blocks, tuple(halos))


def sum_over_tiles(
    function: Callable[[dict[str, Array], Array], PyTree],
    network: FeatureNetwork,
    image: Float[Array, "h w"],
    layers: Sequence[str] = STYLE_LAYERS,
    tile: int = LARGEST_TILE,
    method: str = "auto",
) -> PyTree:
    """The sum over tiles of a function of the tile's responses.

    Args:
        function: of the responses ``{layer: (t, t, n)}`` of a tile (zero outside the image) and of
            its place (row, column), counted in tiles. May be traced several times.
        network: the weights.
        image: Y of the gamma-encoded texture in [0, 1].
        layers: names.
        tile: side of a tile, px; a multiple of the last block's pixel.
        method: how convolutions are computed, see ``conv3x3.METHODS``.

    Raises:
        ValueError: as ``tiling`` and ``features`` do.
    """
    height, width = image.shape
    plan = tiling(network, (height, width), layers, tile)
    halo = plan.halos[0]
    margin = [
        (halo, plan.rows * tile - height + halo),
        (halo, plan.columns * tile - width + halo),
    ]
    padded = jnp.pad(image, margin)

    def place_of(index: Array) -> Array:
        return jnp.stack([index // plan.columns, index % plan.columns])

    def window_of(padded: Array, index: Array) -> Array:
        return lax.dynamic_slice(padded, place_of(index) * tile, (tile + 2 * halo,) * 2)

    def of_window(window: Array, network: FeatureNetwork, index: Array) -> PyTree:
        place = place_of(index)
        return function(
            _responses(network, window, place, plan, (height, width), layers, method), place
        )

    @functools.partial(jax.checkpoint, prevent_cse=False)
    def remade(padded: Array, network: FeatureNetwork, index: Array) -> PyTree:
        return of_window(window_of(padded, index), network, index)

    def step(total: PyTree, index: Array) -> tuple[PyTree, None]:
        return jax.tree.map(jnp.add, total, remade(padded, network, index)), None

    example = jax.eval_shape(remade, padded, network, jnp.zeros((), int))
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), example)
    last = plan.rows * plan.columns - 1
    total = lax.scan(step, zeros, jnp.arange(last))[0]
    # The last tile's responses are kept for its gradient. What is added here is zero, and makes
    # that gradient come before the others', which need the memory.
    window = window_of(padded, jnp.array(last)) + 0 * jax.tree.leaves(total)[0].ravel()[0]
    return jax.tree.map(jnp.add, total, of_window(window, network, jnp.array(last)))


def _responses(
    network: FeatureNetwork,
    window: Float[Array, "s s"],
    place: Int[Array, "2"],
    plan: Tiling,
    shape: tuple[int, int],
    layers: Sequence[str],
    method: str,
) -> dict[str, Float[Array, "_ _ _"]]:
    """Responses of a tile, from its window."""
    wanted: dict[str, Any] = {}
    x: Any = window
    for index, block in enumerate(plan.blocks):
        halo, side = plan.halos[index], plan.tile >> index
        size = side + 2 * halo
        inside = _inside(place * side - halo, size, (shape[0] >> index, shape[1] >> index))
        # As factors: the zeros of a selection would be made before the loop over tiles, and held.
        factor = inside[..., None].astype(window.dtype)
        if index:
            x = factor * pool(x, network.pooling)
        else:
            x = with_indicator(jnp.where(inside, window, 0), inside)
        for name in block:
            y = conv3x3_relu(x, network.kernels[name], network.biases[name], method)
            x = factor * y
            if name in layers:
                wanted[name] = x[halo : halo + side, halo : halo + side]
        cut = len(block)
        x = x[cut : size - cut, cut : size - cut]
    return {name: wanted[name] for name in layers}


def _inside(origin: Int[Array, "2"], size: int, shape: tuple[int, int]) -> Bool[Array, "s s"]:
    """Which pixels of a window at ``origin`` lie in an image of a shape."""
    row, column = (start + jnp.arange(size) for start in origin)
    return ((row >= 0) & (row < shape[0]))[:, None] & ((column >= 0) & (column < shape[1]))


def tile_of_map(
    values: Float[Array, "hl wl n"], layer: str, place: Int[Array, "2"], tile: int
) -> Float[Array, "t t n"]:
    """The part of a layer's map that belongs to a tile; zero outside the image.

    Args:
        values: the layer's map over the whole image.
        layer: its name.
        place: the tile's row and column, counted in tiles.
        tile: side of a tile, px of the image.
    """
    side = tile >> (layer_position(layer)[0] - 1)
    height, width, channels = values.shape
    margin = ((0, -height % side), (0, -width % side), (0, 0))
    padded = jnp.pad(values, margin)
    # An image of odd size may have a last tile in which a pooled map has no pixel of its own.
    exists = jnp.all(place * side < jnp.array(padded.shape[:2]))
    part = lax.dynamic_slice(padded, (*(place * side), 0), (side, side, channels))
    return jnp.where(exists, part, 0)
