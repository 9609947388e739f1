"""Responses of a network to an image that is the same everywhere, of any size.

They vary near the image's border alone, as far as a receptive field reaches. So a small map holds
all of a large one's values: its first rows and columns, its last ones, and one of each between
them that stands for all others. Each block's small map is made of that of the block before, widened
as far as the pooling asks.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxface._types import Bool, Float, Int
from jaxface.networks.texture_features.network import FeatureNetwork


class ConstantMap(NamedTuple):
    """All values of a map of constant input."""

    values: Float[np.ndarray, "a b n"]
    """of the small map"""
    shape: tuple[int, int]
    """of the large map"""

    def at(self, places: Int[np.ndarray, "p"]) -> Float[np.ndarray, "p n"]:
        """Values at places of the large map."""
        y, x = np.divmod(places, self.shape[1])
        height, width = self.values.shape[:2]
        return self.values[_place(y, self.shape[0], height), _place(x, self.shape[1], width)]

    def count(self, where: Bool[np.ndarray, "h w"]) -> Int[np.ndarray, "a b"]:
        """How often each pixel of the small map stands for a true pixel of the large one."""
        for axis, short in enumerate(self.values.shape[:2]):
            first = np.arange(short)
            first[short // 2 + 1 :] += self.shape[axis] - short
            where = np.add.reduceat(where, first, axis=axis, dtype=np.int64)
        return where

    def widened(self, shape: tuple[int, int]) -> Float[np.ndarray, "c d n"]:
        """The map as it would be of an image that is larger than the small map's."""
        y, x = (
            _place(np.arange(side), side, short)
            for side, short in zip(shape, self.values.shape[:2], strict=True)
        )
        return self.values[y[:, None], x]


def _place(index: Int[np.ndarray, "p"], side: int, short: int) -> Int[np.ndarray, "p"]:
    middle = short // 2
    far = index - (side - short)
    return np.where(index < middle, index, np.where(far > middle, far, middle))


def constant_maps(
    network: FeatureNetwork, blocks: Sequence[Sequence[str]], value: float, shape: tuple[int, int]
) -> dict[str, ConstantMap]:
    """Responses of all layers, and each block's input as ``poolB``, to a constant image.

    Args:
        network: the weights.
        blocks: the layers' names, as of `features.blocks_up_to`.
        value: of the image's pixels.
        shape: of the image.
    """
    found: dict[str, ConstantMap] = {}
    reach, last = 0, ""
    for index, block in enumerate(blocks):
        size = (shape[0] >> index, shape[1] >> index)
        reach = -(-reach // 2) + len(block)
        small = tuple(min(side, 2 * reach + 2) for side in size)
        if index:
            above = found[last].shape
            # An odd last row or column is dropped, of the small map as of the large one.
            halves = [
                full if short == side else 2 * short + full % 2
                for full, side, short in zip(above, size, small, strict=True)
            ]
            x = _pooled(found[last].widened((halves[0], halves[1])), network.pooling)
        else:
            x = np.full((*small, 2), np.array([value, 1]), np.float32)
        found[f"pool{index}"] = ConstantMap(x, size)
        for name in block:
            x = _convolved(x, np.asarray(network.kernels[name])) + np.asarray(network.biases[name])
            x = np.maximum(x, 0)
            found[name] = ConstantMap(x, size)
        last = block[-1]
    return found


def _convolved(
    x: Float[np.ndarray, "h w i"], kernel: Float[np.ndarray, "3 3 i o"]
) -> Float[np.ndarray, "h w o"]:
    padded = np.pad(x, ((1, 1), (1, 1), (0, 0)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), axis=(0, 1))
    return np.tensordot(windows, kernel, axes=((3, 4, 2), (0, 1, 2)))


def _pooled(x: Float[np.ndarray, "h w n"], pooling: str) -> Float[np.ndarray, "h2 w2 n"]:
    height, width = (side // 2 * 2 for side in x.shape[:2])
    cells = x[:height, :width].reshape(height // 2, 2, width // 2, 2, -1)
    return cells.max(axis=(1, 3)) if pooling == "max" else cells.mean(axis=(1, 3))
