"""Gram matrices of a masked texture without running the network on all of it again.

G^l(M(I)) of section 4 of Saito 2017 for many textures I and one mask M. The responses that enter
it are of three kinds (see `mask_reach`): those that see visible pixels only are as in the whole
texture, and are cached, with the sums of their products over square cells of large maps; those
that see masked pixels only are the same for every texture; those that see both are computed again,
tile by tile, from cached, constant and computed ones of the map before.

Cached maps are whole numbers up to 65535, each with one scale; cells have a scale each. That
changes a Gram matrix by less than 3e-5 of its Frobenius norm: by up to 2e-5 where one cell holds
a whole small map, by 5e-6 at 1024 pixels, where many cells average.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxface._types import Bool, Float
from jaxface.energies._gram import MASKED
from jaxface.networks.texture_features.constant_response import constant_maps
from jaxface.networks.texture_features.mask_reach import Plan, beside_whole_cells, clear_nodes, plan
from jaxface.networks.texture_features.network import FeatureNetwork, blocks_up_to, layer_position
from jaxface.stages.texture.masked_grams.cells import Layout, Stored
from jaxface.stages.texture.masked_grams.rows import Layer, Workspace, layer_weights


class Prepared(NamedTuple):
    """What a mask asks for of every texture, and its part that is the same for all of them."""

    shape: tuple[int, int]
    pooling: str
    layout: Layout
    plan: Plan
    layers: dict[str, Layer]
    constant: dict[str, Float[np.ndarray, "n n"]]
    """sums over the masked part"""
    nodes: dict[str, np.ndarray]
    """cells that are clear throughout"""
    loose: dict[str, np.ndarray]
    """clear pixels beside them whose cached responses count"""
    workspace: Workspace
    """rows of every map, used again for every texture: not for two threads at once"""

    def for_another_thread(self) -> "Prepared":
        """The same with memory of its own."""
        channels = {name: rows.shape[1] for name, rows in self.workspace.rows.items()}
        own = Workspace(self.plan, channels, self.pooling)
        for table in self.plan.tables:
            own.blank_rows(table)[:] = self.workspace.blank_rows(table)
        return self._replace(workspace=own)


def prepare(network: FeatureNetwork, visible: Bool[np.ndarray, "h w"], layout: Layout) -> Prepared:
    """Prepare a mask: once for any number of textures.

    Args:
        network: the extractor.
        visible: pixels to keep; the others become 0.5.
        layout: of the cached textures.

    Raises:
        ValueError: the mask is not of the textures' shape.
    """
    visible = np.asarray(visible, bool)
    if visible.shape != layout.shapes["image"]:
        raise ValueError(
            f"the mask has shape {visible.shape}; the cached textures have {layout.shapes['image']}"
        )
    blocks = tuple(blocks_up_to(network, layout.cells))
    layers = {name: layer_weights(network, name) for block in blocks for name in block}
    tiled = {name: layer.tiled for name, layer in layers.items()}
    work = plan(blocks, visible, layout.cells, layout.cached, tiled)
    maps = constant_maps(network, blocks, MASKED, visible.shape)
    constant, nodes, loose = {}, {}, {}
    for name, reach in work.reaches.items():
        values = maps[name].values.reshape(-1, network.channels[name])
        times = maps[name].count(reach.blank).reshape(-1, 1)
        constant[name] = (values * times.astype(np.float32)).T @ values
        cell = layout.cells[name]
        nodes[name] = clear_nodes(reach.clear, cell) if cell else np.zeros(0, np.intp)
        beside = beside_whole_cells(reach.clear, cell) & layout.cached[name]
        loose[name] = np.flatnonzero(beside)
    workspace = Workspace(work, _channels(network, blocks), network.pooling)
    for table in work.tables:
        workspace.blank_rows(table)[:] = maps[table.name].at(table.blank)
    return Prepared(
        visible.shape, network.pooling, layout, work, layers, constant, nodes, loose, workspace
    )


def _channels(network: FeatureNetwork, blocks: Sequence[Sequence[str]]) -> dict[str, int]:
    """Channels of every map."""
    found = {"pool0": 2}
    for index, block in enumerate(blocks):
        found |= {name: network.channels[name] for name in block}
        found[f"pool{index + 1}"] = network.channels[block[-1]]
    return found


def masked_grams_of(prepared: Prepared, stored: Stored) -> dict[str, Float[np.ndarray, "n n"]]:
    """Gram matrices of one cached texture behind the prepared mask, by layer.

    Args:
        prepared: the mask's.
        stored: the texture's arrays; those on disk are read only where they are needed.
    """
    space = prepared.workspace
    space.run(stored, prepared.layers)
    found = {}
    for table in prepared.plan.tables:
        name = table.name
        if name not in prepared.constant:
            continue
        total = prepared.constant[name] + space.second_moment(space.rows[name], table.counted)
        if len(prepared.loose[name]):
            scale = stored[f"{name}/scale"][0]
            total += space.second_moment(stored[name], prepared.loose[name]) * scale**2
        if len(prepared.nodes[name]):
            total += _sum_of_nodes(stored, name, prepared.nodes[name], len(total))
        index = layer_position(name)[0] - 1
        found[name] = total / ((prepared.shape[0] >> index) * (prepared.shape[1] >> index))
    return {name: found[name] for name in prepared.layout.cells}


def _sum_of_nodes(stored: Stored, name: str, nodes: np.ndarray, n: int) -> np.ndarray:
    sums = stored[f"{name}/cells"][nodes].astype(np.float32)
    packed = stored[f"{name}/cells/scale"][nodes] @ sums
    total = np.zeros((n, n), np.float32)
    total[np.triu_indices(n)] = packed
    return total + np.triu(total, 1).T
