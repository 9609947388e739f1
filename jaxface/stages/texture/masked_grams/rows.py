"""Rows of channels of a network's maps, computed at a mask's band alone.

By NumPy, on the host, where the rows are gathered; the memory of all rows is taken once and used
for texture after texture.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxface._types import Float, Int
from jaxface.networks.convolution.winograd import transformed_kernel
from jaxface.networks.convolution.winograd_tiles import convolve_tiles, piece, tiles_at_once
from jaxface.networks.texture_features.mask_reach import Plan, Table
from jaxface.networks.texture_features.network import FeatureNetwork

PIXELS_AT_ONCE = 4096
"""pixels of one call of the layers that are computed pixel by pixel"""

NUMBERS_AT_ONCE = 2**18
"""numbers, in whole rows, that are multiplied with themselves at a time"""

_NARROW = 4
"""layers of no more input channels are computed pixel by pixel"""


class Layer(NamedTuple):
    """A layer's weights as `Workspace` needs them."""

    kernel: np.ndarray
    """transformed (36 i o), or (9i o)"""
    bias: np.ndarray
    tiled: bool


def layer_weights(network: FeatureNetwork, name: str) -> Layer:
    """A layer's weights, transformed where it is computed in tiles."""
    kernel, bias = network.kernels[name], np.asarray(network.biases[name])
    if kernel.shape[2] > _NARROW:
        points = np.concatenate(transformed_kernel(jnp.asarray(kernel)))
        return Layer(points, bias, True)
    return Layer(np.asarray(kernel).reshape(-1, kernel.shape[3]), bias, False)


class Workspace:
    """Memory for the rows of every map of a plan, and the work that fills it.

    Attributes:
        rows: of every map, by name; see `mask_reach.Table`.
    """

    def __init__(self, plan: Plan, channels: Mapping[str, int], pooling: str) -> None:
        self.plan, self.pooling = plan, pooling
        self.rows = {
            table.name: _aligned(table.rows, channels[table.name]) for table in plan.tables
        }
        for rows in self.rows.values():
            rows[0] = 0
        self._buffers: dict[str, np.ndarray] = {}

    def blank_rows(self, table: Table) -> Float[np.ndarray, "a n"]:
        """The rows of the constant image, to be written once."""
        start = 1 + table.computed
        return self.rows[table.name][start : start + len(table.blank)]

    def run(self, stored: Mapping[str, np.ndarray], layers: Mapping[str, Layer]) -> None:
        """Fill all rows for one texture.

        Args:
            stored: of the texture, see `cells`; read where it is needed.
            layers: weights by name.
        """
        before = ""
        for table in self.plan.tables:
            rows = self.rows[table.name]
            cached = rows[1 + table.computed + len(table.blank) :]
            if not before:
                cached[:, 0] = stored["image"].reshape(-1).take(table.cached)
                cached[:, 1] = 1
            elif len(table.cached):
                cached[:] = stored[table.name].take(table.cached, axis=0)
                cached *= stored[f"{table.name}/scale"][0]
            if len(table.sources):
                computed, source = rows[1 : 1 + table.computed], self.rows[before]
                if table.layer:
                    layer = layers[table.layer]
                    convolve = self._convolve_tiles if layer.tiled else self._convolve_pixels
                    convolve(table, layer, source, computed)
                else:
                    self._pool(source, table.sources, computed)
            before = table.name

    def _pool(self, source: np.ndarray, sources: np.ndarray, out: np.ndarray) -> None:
        corners = self._buffer("a", *sources.shape, source.shape[1])
        np.take(source, sources, axis=0, mode="clip", out=corners)
        if self.pooling == "max":
            np.max(corners, axis=1, out=out)
        else:
            np.sum(corners, axis=1, out=out)
            out *= 0.25

    def _convolve_pixels(
        self, table: Table, layer: Layer, source: np.ndarray, out: Float[np.ndarray, "r n"]
    ) -> None:
        columns = layer.kernel.shape[0]
        for start in range(0, len(out), PIXELS_AT_ONCE):
            some = table.sources[start : start + PIXELS_AT_ONCE]
            part = out[start : start + PIXELS_AT_ONCE]
            patches = self._buffer("a", *some.shape, source.shape[1])
            np.take(source, some, axis=0, mode="clip", out=patches)
            np.matmul(patches.reshape(-1, columns), layer.kernel, out=part)
            part += layer.bias
            np.maximum(part, 0, out=part)

    def _convolve_tiles(
        self, table: Table, layer: Layer, source: np.ndarray, out: Float[np.ndarray, "r n"]
    ) -> None:
        inputs, outputs = source.shape[1], out.shape[1]
        result = out.reshape(-1, table.pixels, outputs)
        pooling = self.pooling if table.layer != table.name else None
        most = len(result) // -(-len(result) // tiles_at_once(inputs, outputs)) + 1
        size = 37 * most * max(inputs, outputs)
        # Two pieces in turn: as little as there can be, to stay in the processor's cache.
        memory = (self._buffer("a", size), self._buffer("b", size))
        for start in range(0, len(result), most):
            some = table.sources[start : start + most]
            patches = piece(memory[0], *some.shape, inputs)
            np.take(source, some, axis=0, mode="clip", out=patches)
            part = result[start : start + most]
            convolve_tiles(patches, layer.kernel, layer.bias, part, memory, pooling)

    def second_moment(
        self, rows: Float[np.ndarray, "r n"], counted: Int[np.ndarray, "m"]
    ) -> Float[np.ndarray, "n n"]:
        """Sum of ``F F^T`` over some rows, computed or cached ones."""
        total = np.zeros((rows.shape[1],) * 2, np.float32)
        at_once = max(1, NUMBERS_AT_ONCE // rows.shape[1])
        for start in range(0, len(counted), at_once):
            some = counted[start : start + at_once]
            part = self._buffer("a", len(some), rows.shape[1])
            if rows.dtype == np.float32:
                np.take(rows, some, axis=0, mode="clip", out=part)
            else:
                part[:] = rows.take(some, axis=0)
            total += part.T @ part  # NumPy knows that this is symmetric: half the work
        return total

    def _buffer(self, name: str, *shape: int) -> np.ndarray:
        """Uninitialised memory of a shape, the same for every call with this name."""
        size = math.prod(shape)
        if name not in self._buffers or len(self._buffers[name]) < size:
            self._buffers[name] = _aligned(size)
        return piece(self._buffers[name], *shape)


def _aligned(*shape: int) -> Float[np.ndarray, "..."]:
    """An uninitialised array that begins at a line of the processor's cache."""
    size = math.prod(shape)
    memory = np.empty(size + 16, np.float32)
    start = -(memory.ctypes.data // 4) % 16
    return memory[start : start + size].reshape(shape)
