"""Which responses of a network a mask changes, and what must be computed again to know them.

A response whose receptive field is all visible is that of the unmasked image; one whose receptive
field is all masked is that of a constant image. Between the two lies a band along the mask's
outline, the wider the deeper the layer: one pixel more on either side for every 3x3 convolution.
Only the band is computed again, from the cached responses of the last pooling around it.

Everything here depends on the mask and the network's shape alone, not on an image.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion

from jaxface._types import Bool, Int
from jaxface.models.winograd import TILE

PYRAMID = 4
"""levels of a pyramid of cells, each twice as wide as the one before"""

_SQUARE = np.ones((3, 3), bool)


class Reach(NamedTuple):
    """Pixels of a layer's map (h, w) by what their receptive field sees; the rest sees both."""

    clear: Bool[np.ndarray, "h w"]
    """only visible pixels"""
    blank: Bool[np.ndarray, "h w"]
    """only masked pixels"""

    @property
    def mixed(self) -> Bool[np.ndarray, "h w"]:
        """Both visible and masked pixels."""
        return ~(self.clear | self.blank)


class Work(NamedTuple):
    """What has to be computed of one layer, as places in flat maps.

    A *table* holds one row of channels for each computed pixel; row 0 is zero.
    """

    sources: Int[np.ndarray, "36 t"]
    """of the first layers ``9 t``: rows of the input's table, for each tile of outputs"""
    counted: Int[np.ndarray, "m"]
    """rows of the layer's own table that count in its Gram matrix"""


class Splice(NamedTuple):
    """The input of a block, pieced together: rows 1 .. of its table in this order.

    Zeros (row 0), the constant image's responses, cached responses, pooled fresh ones.
    """

    blank: Int[np.ndarray, "a"]
    """places in the constant image's small map"""
    cached: Int[np.ndarray, "b"]
    """places in the texture's full map"""
    fresh: Int[np.ndarray, "4 c"]
    """rows of the table of the layer before the pooling"""


class Plan(NamedTuple):
    """All work for one mask."""

    works: dict[str, Work]
    splices: tuple[Splice, ...]
    """of each block's input; of the first, the image itself"""
    reaches: dict[str, Reach]
    """of the layers asked for"""


def reaches(
    blocks: Sequence[Sequence[str]], visible: Bool[np.ndarray, "h w"], kept: Mapping[str, bool]
) -> tuple[dict[str, Reach], list[Reach]]:
    """What every layer, and every block's input, sees of a mask.

    Args:
        blocks: names of the layers of each block.
        visible: pixels of the image.
        kept: layers for which False is given are taken not to widen the band.
    """
    clear, blank = visible, ~visible
    layers: dict[str, Reach] = {}
    inputs: list[Reach] = []
    for index, block in enumerate(blocks):
        if index:
            clear, blank = _all_of_cell(clear), _all_of_cell(blank)
        inputs.append(Reach(clear, blank))
        for name in block:
            if kept.get(name, True):
                clear = binary_erosion(clear, _SQUARE, border_value=1)
                blank = binary_erosion(blank, _SQUARE, border_value=1)
            layers[name] = Reach(clear, blank)
    return layers, inputs


def _all_of_cell(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h2 w2"]:
    height, width = (side // 2 * 2 for side in mask.shape)
    cells = mask[:height, :width].reshape(height // 2, 2, width // 2, 2)
    return np.asarray(cells.all(axis=(1, 3)))


def whole_cells(mask: Bool[np.ndarray, "h w"], cell: int) -> Bool[np.ndarray, "a b"]:
    """Which square cells of a map are true throughout; the last may hang over its edge."""
    height, width = mask.shape
    padded = np.pad(mask, ((0, -height % cell), (0, -width % cell)), constant_values=True)
    rows, columns = padded.shape[0] // cell, padded.shape[1] // cell
    return np.asarray(padded.reshape(rows, cell, columns, cell).all(axis=(1, 3)))


def clear_nodes(mask: Bool[np.ndarray, "h w"], cell: int) -> Int[np.ndarray, "n"]:
    """The fewest nodes of a pyramid of cells that cover all cells that are true throughout.

    The nodes of a level follow those of the finer one, row by row; see `pyramid_shapes`.
    """
    found, start = [], 0
    shapes = pyramid_shapes(mask.shape, cell)
    for level, (rows, columns) in enumerate(shapes):
        whole = whole_cells(mask, cell << level)
        if level + 1 < len(shapes):
            above = whole_cells(mask, cell << level + 1).repeat(2, axis=0).repeat(2, axis=1)
            found.append(start + np.flatnonzero(whole & ~above[:rows, :columns]))
        else:
            found.append(start + np.flatnonzero(whole))
        start += rows * columns
    return np.concatenate(found)


def pyramid_shapes(shape: tuple[int, ...], cell: int) -> list[tuple[int, int]]:
    """Rows and columns of each level of the pyramid of cells over a map."""
    sides = [cell << level for level in range(PYRAMID)]
    return [(-(-shape[0] // side), -(-shape[1] // side)) for side in sides]


def plan(
    blocks: Sequence[Sequence[str]],
    visible: Bool[np.ndarray, "h w"],
    cells: Mapping[str, int],
    tiled: Mapping[str, bool],
    blank_shape: tuple[int, int],
    kept: Mapping[str, bool],
) -> Plan:
    """Everything that has to be computed again for a mask.

    Args:
        blocks: names of the layers of each block.
        visible: pixels of the image.
        cells: of each layer whose Gram matrix is wanted, the side of the cells whose sums are
            cached (pixels of the layer's map), or 0 where its responses are cached.
        tiled: by layer, whether it is computed in 4x4 tiles or pixel by pixel.
        blank_shape: of the small constant image (see `blank_place`).
        kept: see `reaches`.
    """
    seen, inputs = reaches(blocks, visible, kept)
    needed, wanted_inputs = _needed(blocks, seen, inputs, cells)
    works: dict[str, Work] = {}
    splices: list[Splice] = []
    rows = np.zeros(0, np.intp)
    for index, block in enumerate(blocks):
        shape = inputs[index].clear.shape
        small = (blank_shape[0] >> index, blank_shape[1] >> index)
        above = inputs[max(index - 1, 0)].clear.shape[1]
        rows, splice = _splice(wanted_inputs[index], inputs[index], rows, above, small)
        splices.append(splice)
        for name in block:
            if tiled[name]:
                y, x = covering_tiles(needed[name])
                side = TILE
            else:
                y, x = np.nonzero(needed[name])
                side = 1
            offsets = np.arange(-1, side + 1)
            patch_y = (y[None, None] + offsets[:, None, None]) + 0 * offsets[None, :, None]
            patch_x = (x[None, None] + offsets[None, :, None]) + 0 * offsets[:, None, None]
            ok = (patch_y >= 0) & (patch_y < shape[0]) & (patch_x >= 0) & (patch_x < shape[1])
            place = np.where(ok, patch_y * shape[1] + patch_x, 0)
            sources = np.where(ok, rows.reshape(-1)[place], 0).reshape(len(offsets) ** 2, -1)
            inner = slice(1, side + 1)
            rows = np.zeros(shape[0] * shape[1], np.intp)
            numbers = 1 + np.arange(side * side * len(y), dtype=np.intp)
            numbers = numbers.reshape(side, side, len(y))
            rows[place[inner, inner][ok[inner, inner]]] = numbers[ok[inner, inner]]
            counted = np.zeros(0, np.intp)
            if name in cells:
                counted = rows[np.flatnonzero(_counted(seen[name], cells[name]))]
            works[name] = Work(sources, counted)
    return Plan(works, tuple(splices), {name: seen[name] for name in cells})


def _counted(reach: Reach, cell: int) -> Bool[np.ndarray, "h w"]:
    """Pixels whose responses have to be known: mixed, or clear in a cell that is not all clear."""
    if not cell:
        return reach.mixed
    whole = whole_cells(reach.clear, cell).repeat(cell, axis=0).repeat(cell, axis=1)
    height, width = reach.clear.shape
    return ~reach.blank & ~whole[:height, :width]


def _needed(
    blocks: Sequence[Sequence[str]],
    seen: Mapping[str, Reach],
    inputs: Sequence[Reach],
    cells: Mapping[str, int],
) -> tuple[dict[str, Bool[np.ndarray, "h w"]], list[Bool[np.ndarray, "h w"]]]:
    """Pixels needed of every layer and of every block's input, from the last layer back."""
    needed: dict[str, np.ndarray] = {}
    wanted_inputs: list[np.ndarray] = []
    behind: np.ndarray | None = None  # needed of this block's last layer by the next block
    for index in reversed(range(len(blocks))):
        need = behind if behind is not None else np.zeros(inputs[index].clear.shape, bool)
        for name in reversed(blocks[index]):
            if name in cells:
                need = need | _counted(seen[name], cells[name])
            needed[name] = need
            need = binary_dilation(need, _SQUARE)
        wanted_inputs.insert(0, need)
        if index:
            fresh = (need & inputs[index].mixed).repeat(2, axis=0).repeat(2, axis=1)
            behind = np.zeros(inputs[index - 1].clear.shape, bool)
            behind[: fresh.shape[0], : fresh.shape[1]] = fresh
    return needed, wanted_inputs


def _splice(
    wanted: Bool[np.ndarray, "h w"],
    reach: Reach,
    before: Int[np.ndarray, "p"],
    above: int,
    small: tuple[int, int],
) -> tuple[Int[np.ndarray, "q"], Splice]:
    """Rows of a block's input by place, and where they come from.

    Args:
        wanted: pixels of the input that have to be known.
        reach: what they see.
        before: rows of the table of the layer before the pooling, by place.
        above: width of that layer's map.
        small: the constant image's map.
    """
    height, width = wanted.shape
    blank = np.flatnonzero(wanted & reach.blank & ~reach.clear)
    cached = np.flatnonzero(wanted & reach.clear)
    mixed = np.flatnonzero(wanted & reach.mixed)
    rows = np.zeros(height * width, np.intp)
    order = np.concatenate([blank, cached, mixed])
    rows[order] = 1 + np.arange(len(order))
    fresh = np.zeros((4, 0), np.intp)
    if len(mixed):
        y, x = np.divmod(mixed, width)
        places = [(2 * y + dy) * above + 2 * x + dx for dy in (0, 1) for dx in (0, 1)]
        fresh = np.stack([before[place] for place in places])
    return rows, Splice(blank_place(blank, (height, width), small), cached, fresh)


def blank_place(
    places: Int[np.ndarray, "n"], shape: tuple[int, int], small: tuple[int, int]
) -> Int[np.ndarray, "n"]:
    """Where a small constant image responds as a large one does at given places of a map.

    Responses to a constant image vary only near its border. All rows and columns in between are
    the middle one of the small map.
    """

    def along(index: np.ndarray, full: int, short: int) -> np.ndarray:
        middle = short // 2
        far = index - (full - short)
        return np.where(index < middle, index, np.where(far > middle, far, middle))

    y, x = np.divmod(places, shape[1])
    return along(y, shape[0], small[0]) * small[1] + along(x, shape[1], small[1])


def covering_tiles(
    needed: Bool[np.ndarray, "h w"],
) -> tuple[Int[np.ndarray, "t"], Int[np.ndarray, "t"]]:
    """Tops and left edges of disjoint 4x4 tiles that cover the given pixels: few, not fewest."""
    height, width = needed.shape
    strips = np.pad(needed, ((0, -height % TILE), (0, 0)))
    strips = np.asarray(np.any(strips.reshape(-1, TILE, width), axis=1))
    tops, lefts = [], []
    for strip in np.flatnonzero(np.any(strips, axis=1)).tolist():
        edge = -1
        for column in np.flatnonzero(strips[strip]).tolist():
            if column >= edge:
                tops.append(strip * TILE)
                lefts.append(column)
                edge = column + TILE
    return np.array(tops, np.int64), np.array(lefts, np.int64)
