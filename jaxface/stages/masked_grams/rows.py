"""Rows of channels of a network's maps, computed at a mask's band alone.

The memory of all rows is taken once and used for texture after texture, and every product is of
one of a few shapes, so that a handful of compiled programs serve all masks.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Float, Int
from jaxface.models.features import FeatureNetwork
from jaxface.models.mask_reach import Plan, Table
from jaxface.models.winograd import transformed_kernel
from jaxface.models.winograd_tiles import TILES_AT_ONCE, convolve_tiles

PIXELS_AT_ONCE = 4096
"""pixels of one call of the layers that are computed pixel by pixel"""

ROWS_AT_ONCE = 2048
"""rows of one product; as above"""

_NARROW = 4
"""layers of no more input channels are computed pixel by pixel"""


class Layer(NamedTuple):
    """A layer's weights as `Workspace` needs them."""

    kernel: Array | np.ndarray
    """transformed (36 i o), or (9i o) with the inputs' pixels side by side"""
    bias: Array | np.ndarray
    tiled: bool


def layer_weights(network: FeatureNetwork, name: str) -> Layer:
    """A layer's weights, transformed where it is computed in tiles."""
    kernel, bias = jnp.asarray(network.kernels[name]), jnp.asarray(network.biases[name])
    if kernel.shape[2] > _NARROW:
        return Layer(transformed_kernel(kernel), bias, True)
    columns = np.moveaxis(np.asarray(kernel), 2, 0).reshape(-1, kernel.shape[3])
    return Layer(columns, np.asarray(bias), False)


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
        self._chunks = {
            table.name: _chunks(table.sources)
            for table in plan.tables
            if not table.name.startswith("pool")
        }
        self._buffers: dict[tuple[int, ...], tuple[np.ndarray, np.ndarray]] = {}

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
                cached[:, 0] = stored["image"].reshape(-1)[table.cached]
                cached[:, 1] = 1
            elif len(table.cached):
                scale = stored[f"{table.name}/scale"][0]
                _singles(stored[table.name][table.cached], scale, cached)
            if table.sources.shape[1]:
                computed, source = rows[1 : 1 + table.computed], self.rows[before]
                if table.name in layers:
                    layer = layers[table.name]
                    convolve = self._convolve_tiles if layer.tiled else self._convolve_pixels
                    convolve(table.name, layer, source, computed)
                else:
                    self._pool(source, table.sources, computed)
            before = table.name

    def _pool(self, source: np.ndarray, sources: np.ndarray, out: np.ndarray) -> None:
        corners = self._buffer(0, *sources.shape, source.shape[1])
        np.take(source, sources, axis=0, mode="clip", out=corners)
        if self.pooling == "max":
            np.max(corners, axis=0, out=out)
        else:
            np.sum(corners, axis=0, out=out)
            out *= 0.25

    def _convolve_pixels(
        self, name: str, layer: Layer, source: np.ndarray, out: Float[np.ndarray, "r n"]
    ) -> None:
        channels = np.ascontiguousarray(source.T)
        for number, some in enumerate(self._chunks[name]):
            patches = self._buffer(0, len(channels), *some.shape)
            for channel, patch in zip(channels, patches, strict=True):
                np.take(channel, some, mode="clip", out=patch)
            part = out[number * PIXELS_AT_ONCE :][:PIXELS_AT_ONCE]
            columns = patches.reshape(-1, PIXELS_AT_ONCE)[:, : len(part)]
            np.matmul(columns.T, layer.kernel, out=part)
            part += layer.bias
            np.maximum(part, 0, out=part)

    def _convolve_tiles(
        self, name: str, layer: Layer, source: np.ndarray, out: Float[np.ndarray, "r n"]
    ) -> None:
        result = out.reshape(16, -1, out.shape[1])
        chunks = self._chunks[name]
        waiting: list[tuple[int, Array]] = []
        # One call computes while the patches of the next are gathered into the other buffer.
        for number, some in enumerate(chunks):
            patches = self._buffer(number, *some.shape, source.shape[1])
            np.take(source, some, axis=0, mode="clip", out=patches)
            value = convolve_tiles(patches, layer.kernel, layer.bias)
            waiting.append((number * some.shape[1], value))
            if number:
                _copy(*waiting.pop(0), result)
        for place, value in waiting:
            _copy(place, value, result)

    def second_moment(
        self, rows: Float[np.ndarray, "r n"], counted: Int[np.ndarray, "m"]
    ) -> Float[np.ndarray, "n n"]:
        """Sum of ``F F^T`` over some rows, of single or half precision."""
        total = np.zeros((rows.shape[1],) * 2, np.float32)
        for start in range(0, len(counted), ROWS_AT_ONCE):
            some = counted[start : start + ROWS_AT_ONCE]
            part = self._buffer(0, ROWS_AT_ONCE, rows.shape[1])[: len(some)]
            if rows.dtype == np.float32:
                np.take(rows, some, axis=0, mode="clip", out=part)
            else:
                _singles(rows[some], 1.0, part)
            total += part.T @ part  # NumPy knows that this is symmetric: half the work
        return total

    def _buffer(self, number: int, *shape: int) -> np.ndarray:
        """One of two buffers of a shape, in turn."""
        if shape not in self._buffers:
            self._buffers[shape] = (_aligned(*shape), _aligned(*shape))
        return self._buffers[shape][number % 2]


def _chunks(sources: Int[np.ndarray, "s t"]) -> list[Int[np.ndarray, "s q"]]:
    """Sources of one call each, all of one size, filled up with row 0."""
    step = TILES_AT_ONCE if len(sources) == 36 else PIXELS_AT_ONCE
    padded = np.pad(sources, ((0, 0), (0, -sources.shape[1] % step)))
    starts = range(0, padded.shape[1], step)
    return [np.ascontiguousarray(padded[:, start : start + step]) for start in starts]


def _singles(half: Float[np.ndarray, "r n"], scale: float, out: Float[np.ndarray, "r n"]) -> None:
    """Half precision to single, times a scale; no number is negative.

    A half's bits in a single's place are 2^-112 of its value: five times as fast as NumPy's cast.
    """
    bits = half.view(np.uint16).astype(np.uint32)
    bits <<= 13
    np.multiply(bits.view(np.float32), np.float32(scale * 2.0**112), out=out)


def _copy(place: int, value: Array, out: Float[np.ndarray, "k t n"]) -> None:
    size = min(value.shape[1], out.shape[1] - place)
    out[:, place : place + size] = np.asarray(value)[:, :size]


def _aligned(*shape: int) -> Float[np.ndarray, "..."]:
    """An uninitialised array that XLA reads where it lies, without a copy."""
    size = math.prod(shape)
    memory = np.empty(size + 16, np.float32)
    start = -(memory.ctypes.data // 4) % 16
    return memory[start : start + size].reshape(shape)
