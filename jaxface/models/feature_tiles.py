"""Sums over an image's feature responses, tile by tile, in memory that the tile bounds.

Each tile is computed from a window that is larger by the receptive field, and counts for itself
alone: what the window's own edges disturb is outside the tile. Windows lie within the image, so
that its edges are theirs, and zero padding is what it is for the whole image. Only an image that
no whole number of the last block's pixels covers is filled up, and responses beyond its edge set
to zero after every layer. So the responses are those of the whole image.

The sum is linear in what each tile adds, and each tile is rematerialised: reverse mode visits the
tiles twice, once for the sums and once, with the sums' cotangent known, for the gradient.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxface._types import Array, Bool, Float, Int, PyTree
from jaxface.models.conv3x3 import conv3x3_relu
from jaxface.models.features import (
    STYLE_LAYERS,
    FeatureNetwork,
    blocks_up_to,
    layer_position,
    pool,
    with_indicator,
)

LARGEST_TILE = 1024
"""px; with VGG-19 to conv5_1 tiles of this size take about 1.9 GB for loss and gradient"""


def even_tile(shape: tuple[int, int], largest: int = LARGEST_TILE) -> int:
    """Side of the tiles, at most ``largest``, that cover an image (h, w) with the least overhang.

    A multiple of 16, which suits every layer up to block 5.
    """
    count = -(-max(shape) // largest)
    return -(-max(shape) // (16 * count)) * 16


class Cuts(NamedTuple):
    """How one axis of an image is cut; pixels of the image, all of them multiples of ``pixel``."""

    edges: tuple[int, ...]
    """of the tiles, from 0 to the filled-up side"""
    starts: tuple[int, ...]
    """of their windows"""
    window: int
    """size of every window"""


class Window(NamedTuple):
    """One tile's window while it is computed."""

    start: Int[Array, "2"]
    """row and column of its first pixel"""
    low: Int[Array, "2"]
    """row and column of the tile's first pixel"""
    high: Int[Array, "2"]
    """row and column after the tile's last pixel"""
    shape: tuple[int, int]
    """rows and columns of the window"""
    full: tuple[int, int]
    """rows and columns of the image, filled up"""

    def tile_mask(self, block: int) -> Bool[Array, "h w 1"]:
        """Which pixels of the window's map in a block (from 0) are the tile's."""
        return _within(self.low, self.high, self.start, self.shape, block)


def cuts(side: int, tile: int, halo: int, pixel: int) -> Cuts:
    """Cut an axis into tiles of about one size, and windows of one size that lie within it.

    Tiles at the ends have a neighbour on one side alone, so they are larger than the others by
    ``halo`` where the axis is long enough.

    Args:
        side: of the image, px.
        tile: mean size of the tiles at most.
        halo: pixels that a window needs beyond its tile, a multiple of ``pixel``.
        pixel: of which everything is to be a multiple.
    """
    count = -(-side // tile)
    full = -(-side // pixel) * pixel
    inner = -(-max(full - 2 * halo, 0) // (count * pixel)) * pixel
    inside = [halo + index * inner for index in range(1, count)]
    if inside and (inner == 0 or inside[-1] >= full):
        even = -(-full // (count * pixel)) * pixel
        inside = list(range(even, full, even))
    edges = [0, *inside, full]
    needs = [
        (max(low - halo, 0), min(high + halo, full))
        for low, high in zip(edges[:-1], edges[1:], strict=True)
    ]
    window = max(high - low for low, high in needs)
    starts = [min(low, full - window) for low, _ in needs]
    return Cuts(tuple(edges), tuple(starts), window)


class Tiling(NamedTuple):
    """How an image is cut for a network."""

    rows: Cuts
    columns: Cuts
    blocks: tuple[tuple[str, ...], ...]

    @property
    def full(self) -> tuple[int, int]:
        """Rows and columns of the image, filled up to whole pixels of the last block."""
        return self.rows.edges[-1], self.columns.edges[-1]

    @property
    def count(self) -> int:
        """Number of tiles."""
        return len(self.rows.starts) * len(self.columns.starts)

    def window(self, index: Int[Array, ""]) -> Window:
        """A tile's window; tiles are counted row by row."""
        across = len(self.columns.starts)
        places = index // across, index % across

        def at(values: Sequence[Sequence[int]]) -> Array:
            pairs = zip(values, places, strict=True)
            return jnp.stack([jnp.asarray(axis, jnp.int32)[place] for axis, place in pairs])

        axes = self.rows, self.columns
        return Window(
            at([axis.starts for axis in axes]),
            at([axis.edges[:-1] for axis in axes]),
            at([axis.edges[1:] for axis in axes]),
            (self.rows.window, self.columns.window),
            self.full,
        )


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
    reach = sum(len(block) << index for index, block in enumerate(blocks))
    halo = -(-reach // pixel) * pixel
    rows, columns = (cuts(side, tile, halo, pixel) for side in shape)
    return Tiling(rows, columns, blocks)


def sum_over_tiles(
    function: Callable[[dict[str, Array], Window], PyTree],
    network: FeatureNetwork,
    image: Float[Array, "h w"],
    layers: Sequence[str] = STYLE_LAYERS,
    tile: int = LARGEST_TILE,
    method: str = "auto",
) -> PyTree:
    """The sum over tiles of a function of the tile's responses.

    Args:
        function: of the responses ``{layer: (a, b, n)}`` in a tile's window, right where
            ``tile_mask`` is true, and of that window. May be traced several times.
        network: the weights.
        image: Y of the gamma-encoded texture in [0, 1].
        layers: names.
        tile: mean side of a tile at most, px; a multiple of the last block's pixel.
        method: how convolutions are computed, see ``conv3x3.METHODS``.

    Raises:
        ValueError: as ``tiling`` and ``features`` do.
    """
    height, width = image.shape
    plan = tiling(network, (height, width), layers, tile)
    padded = jnp.pad(image, ((0, plan.full[0] - height), (0, plan.full[1] - width)))

    def of_tile(padded: Array, network: FeatureNetwork, index: Array) -> PyTree:
        window = plan.window(index)
        part = lax.dynamic_slice(padded, tuple(window.start), window.shape)
        found = _responses(network, part, window, plan.blocks, (height, width), layers, method)
        return function(found, window)

    remade = jax.checkpoint(of_tile, prevent_cse=False)

    def step(total: PyTree, index: Array) -> tuple[PyTree, None]:
        return jax.tree.map(jnp.add, total, remade(padded, network, index)), None

    example = jax.eval_shape(of_tile, padded, network, jnp.zeros((), int))
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), example)
    return lax.scan(step, zeros, jnp.arange(plan.count))[0]


def _responses(
    network: FeatureNetwork,
    part: Float[Array, "a b"],
    window: Window,
    blocks: Sequence[Sequence[str]],
    shape: tuple[int, int],
    layers: Sequence[str],
    method: str,
) -> dict[str, Float[Array, "a b n"]]:
    """Responses of a tile, from the part of the image in its window."""
    whole = all(side % 2 ** (len(blocks) - 1) == 0 for side in shape)
    wanted: dict[str, Any] = {}
    x: Any = part
    for index, block in enumerate(blocks):
        # As factors: the zeros of a selection would be made before the loop over tiles, and held.
        inside: Any = 1.0
        if not whole:
            end = jnp.array([side >> index << index for side in shape])
            found = _within(jnp.zeros(2, int), end, window.start, window.shape, index)
            inside = found.astype(part.dtype)
        if index:
            x = inside * pool(x, network.pooling)
        else:
            x = inside * with_indicator(part)
        for name in block:
            x = inside * conv3x3_relu(x, network.kernels[name], network.biases[name], method)
            if name in layers:
                wanted[name] = x
    return {name: wanted[name] for name in layers}


def _within(
    low: Int[Array, "2"],
    high: Int[Array, "2"],
    start: Int[Array, "2"],
    shape: tuple[int, int],
    block: int,
) -> Bool[Array, "h w 1"]:
    """Which pixels of a window's map in a block lie between two corners (px of the image)."""
    row, column = (
        (first >> block) + jnp.arange(size >> block)
        for first, size in zip(start, shape, strict=True)
    )
    low, high = low >> block, high >> block
    rows = (row >= low[0]) & (row < high[0])
    columns = (column >= low[1]) & (column < high[1])
    return (rows[:, None] & columns)[..., None]


def window_of_map(
    values: Float[Array, "hl wl n"], layer: str, window: Window
) -> Float[Array, "a b n"]:
    """The part of a layer's map in a tile's window; zero outside the image.

    Args:
        values: the layer's map over the whole image.
        layer: its name.
        window: the tile's.
    """
    block = layer_position(layer)[0] - 1
    height, width, channels = values.shape
    size = (window.shape[0] >> block, window.shape[1] >> block, channels)
    margin = ((0, (window.full[0] >> block) - height), (0, (window.full[1] >> block) - width))
    padded = jnp.pad(values, (*margin, (0, 0)))
    first = window.start >> block
    return lax.dynamic_slice(padded, (first[0], first[1], jnp.zeros_like(first[0])), size)
