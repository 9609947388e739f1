"""What is cached of a texture, so that its masked Gram matrices need little of the network.

The result of every pooling; the responses of the layers from the second block on that the next
layer of their block, or a Gram matrix, asks for; and of large maps with a Gram matrix the sums
of ``F F^T`` over square cells, in a pyramid. See `splice` for what they are for.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxface._types import Array, Float
from jaxface.networks.convolution.conv3x3 import conv3x3_relu
from jaxface.networks.texture_features.mask_reach import pyramid_shapes
from jaxface.networks.texture_features.network import (
    STYLE_LAYERS,
    FeatureNetwork,
    blocks_up_to,
    pool,
    with_indicator,
)

Stored = Mapping[str, np.ndarray]
"""what is cached of a texture, by the names of `layout`"""

LEVELS = 2**16 - 1
"""what the largest cached value becomes"""

_LARGEST_CELLS = 8.5
"""numbers in a layer's finest cells, for each pixel of the texture, at most"""

_FINEST = 16
"""px of a layer's map, side of the finest cells"""

_SMALLEST_CELLED = 128
"""px; smaller maps have no cells"""


class Layout(NamedTuple):
    """What is cached of a texture of one shape: shape and type of each array."""

    shapes: dict[str, tuple[int, ...]]
    types: dict[str, str]
    cells: dict[str, int]
    """of each layer with a Gram matrix, side of its cells in pixels of its map; 0: none"""
    cached: dict[str, bool]
    """of each layer, whether its responses are cached"""

    @property
    def bytes(self) -> int:
        """Bytes of one texture."""
        return sum(
            math.prod(shape) * np.dtype(self.types[name]).itemsize
            for name, shape in self.shapes.items()
        )


def layout(
    network: FeatureNetwork,
    shape: tuple[int, int],
    layers: Sequence[str] = STYLE_LAYERS,
    cells: Mapping[str, int] | None = None,
) -> Layout:
    """What has to be cached of a texture.

    Args:
        network: the extractor.
        shape: height and width of the textures.
        layers: those whose Gram matrices are wanted.
        cells: by layer, side of its cells (px of its map), 0 to cache responses alone; by default
            the smallest power of two, from 16, whose sums are not too many.

    Raises:
        ValueError: a layer is unknown, or its map would be empty.
    """
    blocks = blocks_up_to(network, layers)
    if min(shape) >> (len(blocks) - 1) == 0:
        raise ValueError(f"a texture of {shape[0]}x{shape[1]} pixels has no {blocks[-1][-1]}")
    shapes: dict[str, tuple[int, ...]] = {"image": shape}
    types = {"image": "<f4"}
    chosen: dict[str, int] = {}
    cached: dict[str, bool] = {}
    for index, block in enumerate(blocks):
        height, width = shape[0] >> index, shape[1] >> index
        if index:
            channels = network.channels[blocks[index - 1][-1]]
            shapes[f"pool{index}"] = (height * width, channels)
        for name in block:
            n = network.channels[name]
            if name in layers:
                cell = _FINEST if min(height, width) >= _SMALLEST_CELLED else 0
                while cell and _packed(n) * math.prod(pyramid_shapes((height, width), cell)[0]) > (
                    _LARGEST_CELLS * math.prod(shape)
                ):
                    cell *= 2
                cell = chosen[name] = cell if cells is None else cells.get(name, cell)
                if cell:
                    count = sum(math.prod(level) for level in pyramid_shapes((height, width), cell))
                    shapes[f"{name}/cells"] = (count, _packed(n))
            # The first block's are as large as all others together, and cheap.
            cached[name] = chosen.get(name) == 0 or (
                index > 0 and (name in layers or name != block[-1])
            )
            if cached[name]:
                shapes[name] = (height * width, n)
    for name in list(shapes)[1:]:
        types[name], types[f"{name}/scale"] = "<u2", "<f4"
        shapes[f"{name}/scale"] = (shapes[name][0] if name.endswith("cells") else 1,)
    return Layout(shapes, types, {name: chosen[name] for name in layers}, cached)


def _packed(n: int) -> int:
    return n * (n + 1) // 2


def store(network: FeatureNetwork, image: Float[Array, "h w"], layout: Layout) -> dict[str, Array]:
    """What is cached of a texture, in single precision; see `compressed`. May be jitted.

    Args:
        network: the extractor.
        image: intensity in [0, 1], whole.
        layout: as `layout` makes it for this network and shape.
    """
    found: dict[str, Array] = {"image": image}
    x = with_indicator(image)
    for index, block in enumerate(blocks_up_to(network, layout.cells)):
        if index:
            x = pool(x, network.pooling)
            found[f"pool{index}"] = x.reshape(-1, x.shape[-1])
        for name in block:
            x = conv3x3_relu(x, network.kernels[name], network.biases[name])
            if layout.cells.get(name):
                found[f"{name}/cells"] = _cell_sums(x, layout.cells[name])
            if layout.cached[name]:
                found[name] = x.reshape(-1, x.shape[-1])
    return found


def compressed(found: Mapping[str, Array], layout: Layout) -> dict[str, np.ndarray]:
    """The arrays that go to disk: whole numbers of 16 bits, with the scales that belong to them.

    Nothing here is negative. Even steps are finer than half precision's where it matters, at large
    values, and turn into single precision in one pass.
    """
    stored: dict[str, np.ndarray] = {}
    for name, value in found.items():
        array = np.asarray(value, np.float32)
        if layout.types[name] == "<u2":
            axis = 1 if name.endswith("cells") else (0, 1)
            scale = np.maximum(array.max(axis=axis, keepdims=True) / LEVELS, 1e-30)
            stored[f"{name}/scale"] = scale.reshape(-1).astype("<f4")
            array = np.rint(array / scale)
        stored[name] = np.ascontiguousarray(array, layout.types[name])
    return stored


def _cell_sums(x: Float[Array, "h w n"], cell: int) -> Float[Array, "c m"]:
    """Upper triangles of ``sum F F^T`` over the nodes of a pyramid of square cells."""
    height, width, n = x.shape
    x = jnp.pad(x, ((0, -height % cell), (0, -width % cell), (0, 0)))
    rows, columns = x.shape[0] // cell, x.shape[1] // cell
    upper = np.triu_indices(n)

    def of_row(strip: Array) -> Array:
        parts = strip.reshape(cell, columns, cell, n)
        return jnp.einsum("ycxi,ycxj->cij", parts, parts)[:, upper[0], upper[1]]

    sums = lax.map(of_row, x.reshape(rows, cell, columns * cell, n))
    levels = [sums]
    for rows, columns in pyramid_shapes((height, width), cell)[1:]:
        odd = [(0, 2 * rows - sums.shape[0]), (0, 2 * columns - sums.shape[1]), (0, 0)]
        sums = jnp.pad(sums, odd).reshape(rows, 2, columns, 2, -1).sum(axis=(1, 3))
        levels.append(sums)
    return jnp.concatenate([level.reshape(-1, level.shape[-1]) for level in levels])
