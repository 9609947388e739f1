"""Gram matrices of a masked texture without running the network on all of it again.

G^l(M(I)) of section 4 of Saito 2017 for many textures I and one mask M. The responses that enter
it are of three kinds (see `mask_reach`): those that see visible pixels only are as in the whole
texture, and their products are cached as sums over square cells of each layer's map; those that
see masked pixels only are the same for every texture; those that see both are computed again,
tile by tile, from what is cached of each pooling's result.

Cached maps are half precision, each scaled by its largest value; cells have a scale each. That
changes a Gram matrix by less than 5e-4 of its Frobenius norm, half precision's own rounding: by
2e-4 where one cell holds a whole small map, by 6e-5 at 1024 pixels, where many cells average.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxface._types import Array, Bool, Float
from jaxface.energies.gram import MASKED
from jaxface.models.conv3x3 import conv3x3_relu
from jaxface.models.features import (
    FeatureNetwork,
    blocks_up_to,
    layer_position,
    pool,
    with_indicator,
)
from jaxface.models.mask_reach import Plan, blank_place, clear_nodes, plan
from jaxface.models.winograd_tiles import (
    TILES_AT_ONCE,
    convolve_pixels,
    convolve_tiles,
    transformed_kernel,
)
from jaxface.stages.masked_grams.cells import Layout, Stored

ROWS_AT_ONCE = 2048
"""pixels of one product; smaller ones are filled up with zeros"""


class _Layer(NamedTuple):
    """A layer's weights as the tiles need them."""

    kernel: Array
    bias: Array
    tiled: bool


class Prepared(NamedTuple):
    """What a mask asks for of every texture, and its part that is the same for all of them."""

    shape: tuple[int, int]
    blocks: tuple[tuple[str, ...], ...]
    pooling: str
    layout: Layout
    plan: Plan
    layers: dict[str, _Layer]
    blank: tuple[np.ndarray, ...]
    """by block: rows of the constant image at the places of the block's splice"""
    constant: dict[str, Float[np.ndarray, "n n"]]
    """sums over the masked part"""
    clear: dict[str, np.ndarray]
    """whole cells, or pixels where responses are cached"""


def prepare(
    network: FeatureNetwork,
    visible: Bool[np.ndarray, "h w"],
    layout: Layout,
    unwidened: Sequence[str] = (),
) -> Prepared:
    """Prepare a mask: once for any number of textures, some seconds with compilation.

    Args:
        network: the extractor.
        visible: pixels to keep; the others become 0.5.
        layout: of the cached textures.
        unwidened: layers that are taken not to widen the band of mixed responses. Far from the
            outline a receptive field sees the other side through its faint rim only, so the
            band can be kept narrower than it exactly is; none by default, which is exact.

    Raises:
        ValueError: the mask is not of the textures' shape.
    """
    visible = np.asarray(visible, bool)
    if visible.shape != layout.shapes["image"]:
        raise ValueError(
            f"the mask has shape {visible.shape}; the cached textures have {layout.shapes['image']}"
        )
    blocks = tuple(blocks_up_to(network, layout.cells))
    tiled = {name: network.kernels[name].shape[2] > 4 for block in blocks for name in block}
    rows, columns = (_blank_side(side, blocks) for side in visible.shape)
    small = (rows, columns)
    kept = {name: False for name in unwidened}
    work = plan(blocks, visible, layout.cells, tiled, small, kept)
    maps = _blank_maps(network, small, blocks)
    constant, clear = {}, {}
    for name, reach in work.reaches.items():
        index = layer_position(name)[0] - 1
        short = (small[0] >> index, small[1] >> index)
        places = blank_place(np.flatnonzero(reach.blank), reach.blank.shape, short)
        times = np.bincount(places, minlength=short[0] * short[1])
        present = np.flatnonzero(times)
        rows = maps[name][present]
        constant[name] = (rows * times[present, None].astype(np.float32)).T @ rows
        cell = layout.cells[name]
        clear[name] = clear_nodes(reach.clear, cell) if cell else np.flatnonzero(reach.clear)
    weights = {
        name: _Layer(
            transformed_kernel(network.kernels[name])
            if tiled[name]
            else jnp.asarray(network.kernels[name]).reshape(9, -1, network.channels[name]),
            network.biases[name],
            tiled[name],
        )
        for name in work.works
    }
    blank = tuple(maps[f"pool{index}"][splice.blank] for index, splice in enumerate(work.splices))
    return Prepared(
        visible.shape, blocks, network.pooling, layout, work, weights, blank, constant, clear
    )


def _blank_side(side: int, blocks: Sequence[Sequence[str]]) -> int:
    """Side of a small constant image whose border region is that of a large one."""
    reach = sum((len(block) + 1) << index for index, block in enumerate(blocks))
    pixel = 1 << len(blocks)
    return min(side, -(-2 * reach // pixel) * pixel + 2 * pixel + side % pixel)


def _blank_maps(
    network: FeatureNetwork, shape: tuple[int, int], blocks: Sequence[tuple[str, ...]]
) -> dict[str, Float[np.ndarray, "p n"]]:
    """All responses to a constant image, and each block's input as ``poolB``."""
    found = _blank_responses(network, shape, tuple(blocks))
    return {name: np.asarray(value) for name, value in found.items()}


@partial(jax.jit, static_argnums=(1, 2))
def _blank_responses(
    network: FeatureNetwork, shape: tuple[int, int], blocks: tuple[tuple[str, ...], ...]
) -> dict[str, Array]:
    x = with_indicator(jnp.full(shape, MASKED, jnp.float32))
    found = {}
    for index, block in enumerate(blocks):
        x = pool(x, network.pooling) if index else x
        found[f"pool{index}"] = x
        for name in block:
            x = found[name] = conv3x3_relu(x, network.kernels[name], network.biases[name])
    return {name: value.reshape(-1, value.shape[-1]) for name, value in found.items()}


def masked_grams_of(prepared: Prepared, stored: Stored) -> dict[str, Float[np.ndarray, "n n"]]:
    """Gram matrices of one cached texture behind the prepared mask, by layer.

    Args:
        prepared: the mask's.
        stored: the texture's arrays; those on disk are read only where they are needed.
    """
    found: dict[str, np.ndarray] = {}
    rows = np.zeros((1, 1), np.float32)
    for index, block in enumerate(prepared.blocks):
        rows = _spliced(prepared, stored, index, rows)
        for name in block:
            work = prepared.plan.works[name]
            rows = _convolved(prepared.layers[name], rows, work.sources)
            if name in prepared.constant:
                total = prepared.constant[name] + _second_moment(rows, work.counted)
                total += _clear_sum(prepared, stored, name)
                pixels = (prepared.shape[0] >> index) * (prepared.shape[1] >> index)
                found[name] = total / pixels
    return {name: found[name] for name in prepared.layout.cells}


def _spliced(
    prepared: Prepared, stored: Stored, index: int, before: Float[np.ndarray, "r n"]
) -> Float[np.ndarray, "q m"]:
    """Table of a block's input."""
    splice, blank = prepared.plan.splices[index], prepared.blank[index]
    a, b, c = len(splice.blank), len(splice.cached), splice.fresh.shape[1]
    table = np.empty((1 + a + b + c, blank.shape[1]), np.float32)
    table[0] = 0
    table[1 : 1 + a] = blank
    part = table[1 + a : 1 + a + b]
    if index == 0:
        part[:, 0] = stored["image"].reshape(-1)[splice.cached]
        part[:, 1] = 1
        return table
    np.multiply(
        stored[f"pool{index}"][splice.cached],
        stored[f"pool{index}/scale"],
        out=part,
        dtype=np.float32,
    )
    if c:
        part = table[1 + a + b :]
        corners = [before[corner] for corner in splice.fresh]
        if prepared.pooling == "max":
            np.maximum(np.maximum(*corners[:2]), np.maximum(*corners[2:]), out=part)
        else:
            np.add(corners[0] + corners[1], corners[2] + corners[3], out=part)
            part *= 0.25
    return table


def _convolved(
    layer: _Layer, rows: Float[np.ndarray, "q i"], sources: np.ndarray
) -> Float[np.ndarray, "r o"]:
    """Table of a layer from that of its input."""
    count = sources.shape[1]
    outputs = layer.bias.shape[0]
    of_tile, step = (16, TILES_AT_ONCE) if layer.tiled else (1, ROWS_AT_ONCE)
    convolve = convolve_tiles if layer.tiled else convolve_pixels
    table = np.empty((1 + of_tile * count, outputs), np.float32)
    table[0] = 0
    tiles = table[1:].reshape(of_tile, count, outputs)
    padded = np.pad(sources, ((0, 0), (0, -count % (step // 4))))  # row 0 is zero
    # One call computes while the patches of the next are gathered.
    waiting: list[tuple[int, Array]] = []
    for start in range(0, count, step):
        some = padded[:, start : start + step]
        patches = _aligned(*some.shape, rows.shape[1])
        np.take(rows, some, axis=0, mode="clip", out=patches)
        waiting.append((start, convolve(patches, layer.kernel, layer.bias)))
        if len(waiting) > 1 or start + step >= count:
            for place, result in waiting:
                size = min(step, count - place)
                tiles[:, place : place + size] = np.asarray(result)[:, :size]
            waiting.clear()
    return table


def _aligned(*shape: int) -> Float[np.ndarray, "..."]:
    """An uninitialised array that XLA reads where it lies, without a copy."""
    size = math.prod(shape)
    memory = np.empty(size + 16, np.float32)
    start = -(memory.ctypes.data // 4) % 16
    return memory[start : start + size].reshape(shape)


@jax.jit
def _add_products(total: Float[Array, "n n"], rows: Float[Array, "r n"]) -> Float[Array, "n n"]:
    return total + lax.dot_general(rows, rows, (((0,), (0,)), ((), ())))


def _second_moment(rows: Float[np.ndarray, "r n"], counted: np.ndarray) -> Float[np.ndarray, "n n"]:
    """Sum of ``F F^T`` over some rows; products of one shape, so that one program serves all."""
    total = jnp.zeros((rows.shape[1],) * 2, jnp.float32)
    for start in range(0, len(counted), ROWS_AT_ONCE):
        some = counted[start : start + ROWS_AT_ONCE]
        size = -(-len(some) // (ROWS_AT_ONCE // 4)) * (ROWS_AT_ONCE // 4)
        part = _aligned(size, rows.shape[1])
        part[: len(some)] = rows.take(some, axis=0, mode="clip")
        part[len(some) :] = 0
        total = _add_products(total, part)
    return np.asarray(total)


def _clear_sum(prepared: Prepared, stored: Stored, name: str) -> Float[np.ndarray, "n n"]:
    """Sum over the pixels that are as in the whole texture and are not computed again."""
    clear = prepared.clear[name]
    n = len(prepared.constant[name])
    if not prepared.layout.cells[name]:
        return _second_moment(stored[name], clear) * stored[f"{name}/scale"][0] ** 2
    sums = stored[f"{name}/cells"][clear].astype(np.float32)
    packed = np.einsum("c,cm->m", stored[f"{name}/cells/scale"][clear], sums)
    total = np.zeros((n, n), np.float32)
    total[np.triu_indices(n)] = packed
    return total + np.triu(total, 1).T
