"""Which responses of a network a mask changes, and what must be computed again to know them.

A response whose receptive field is all visible is that of the unmasked image; one whose receptive
field is all masked is that of a constant image. Between the two lies a band along the mask's
outline, the wider the deeper the layer: one pixel more on either side for every 3x3 convolution.
Only the band is computed again, layer by layer; around it stand cached responses of the texture
and those of the constant image.

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
    """Pixels of a map (h, w) by what their receptive field sees; the rest sees both."""

    clear: Bool[np.ndarray, "h w"]
    """only visible pixels"""
    blank: Bool[np.ndarray, "h w"]
    """only masked pixels"""

    @property
    def mixed(self) -> Bool[np.ndarray, "h w"]:
        """Both visible and masked pixels."""
        return ~(self.clear | self.blank)


class Table(NamedTuple):
    """The pixels of one map that are needed, as rows of channels.

    Row 0 is zero. The rows computed from those of the map before follow, then rows of the
    constant image, then cached ones. Maps are the layers, and each block's input ``poolB``.
    """

    name: str
    sources: Int[np.ndarray, "s t"]
    """rows of the table before: 36 of a 6x6 patch for each tile of 4x4 computed pixels (first all
    tiles' first pixels, then their second ones, ...), 9 for each single pixel, or the 4 of a
    pooled one; 0 rows for the image itself"""
    blank: Int[np.ndarray, "a"]
    """places in the constant image's small map (see `blank_place`)"""
    cached: Int[np.ndarray, "b"]
    """places in the texture's full map"""
    counted: Int[np.ndarray, "m"]
    """rows, all computed ones, that count in the layer's Gram matrix"""

    @property
    def computed(self) -> int:
        """Number of computed rows."""
        return self.sources.shape[1] * (TILE**2 if len(self.sources) == 36 else 1)

    @property
    def rows(self) -> int:
        """Number of rows."""
        return 1 + self.computed + len(self.blank) + len(self.cached)


class Plan(NamedTuple):
    """All work for one mask."""

    tables: tuple[Table, ...]
    """from the image on"""
    reaches: dict[str, Reach]
    """of the layers asked for"""


def maps_of(blocks: Sequence[Sequence[str]]) -> list[str]:
    """Names of all maps in order: each block's input ``poolB``, then its layers."""
    return [name for index, block in enumerate(blocks) for name in (f"pool{index}", *block)]


def reaches(blocks: Sequence[Sequence[str]], visible: Bool[np.ndarray, "h w"]) -> dict[str, Reach]:
    """What the pixels of every map see of a mask."""
    clear, blank = visible, ~visible
    found: dict[str, Reach] = {}
    for index, name in enumerate(maps_of(blocks)):
        if name.startswith("pool") and index:
            clear, blank = _all_of_cell(clear), _all_of_cell(blank)
        elif index:
            clear = binary_erosion(clear, _SQUARE, border_value=1)
            blank = binary_erosion(blank, _SQUARE, border_value=1)
        found[name] = Reach(clear, blank)
    return found


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


def beside_whole_cells(mask: Bool[np.ndarray, "h w"], cell: int) -> Bool[np.ndarray, "h w"]:
    """The true pixels that lie in no cell that is true throughout; all true ones for ``cell`` 0."""
    if not cell:
        return mask
    whole = whole_cells(mask, cell).repeat(cell, axis=0).repeat(cell, axis=1)
    return mask & ~whole[: mask.shape[0], : mask.shape[1]]


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
    cached: Mapping[str, bool],
    tiled: Mapping[str, bool],
    blank_shape: tuple[int, int],
) -> Plan:
    """Everything that has to be computed again for a mask.

    Args:
        blocks: names of the layers of each block.
        visible: pixels of the image.
        cells: of each layer whose Gram matrix is wanted, the side of the cells whose sums are
            cached (pixels of the layer's map), or 0 where none are.
        cached: of each layer, whether its responses to the texture are cached; and of a block's
            input ``poolB`` where it is not.
        tiled: by layer, whether it is computed in 4x4 tiles or pixel by pixel.
        blank_shape: of the small constant image (see `blank_place`).
    """
    seen = reaches(blocks, visible)
    wanted = _wanted(blocks, seen, cells, cached)
    tables: list[Table] = []
    rows, width = np.zeros(0, np.intp), 0
    block = -1
    for name in maps_of(blocks):
        reach, (need, computed) = seen[name], wanted[name]
        block += name.startswith("pool")
        if name.startswith("pool"):
            sources, places = _pooling(computed, rows, width)
        else:
            sources, places = _patches(computed, rows, tiled[name])
        blank = np.flatnonzero(need & reach.blank & ~computed)
        whole = np.flatnonzero(need & reach.clear & ~computed)
        rows, width = np.zeros(need.size, np.intp), need.shape[1]
        inside = places >= 0
        rows[places[inside]] = 1 + np.flatnonzero(inside)
        # A tile's other pixels may lack their sources; what is known stands instead of them.
        rows[blank] = 1 + places.size + np.arange(len(blank))
        rows[whole] = 1 + places.size + len(blank) + np.arange(len(whole))
        counted = np.zeros(0, np.intp)
        if name in cells:
            counted = rows[np.flatnonzero(_counted(reach, cells[name], cached[name]))]
        small = (blank_shape[0] >> block, blank_shape[1] >> block)
        tables.append(Table(name, sources, blank_place(blank, need.shape, small), whole, counted))
    return Plan(tuple(tables), {name: seen[name] for name in cells})


def _counted(reach: Reach, cell: int, cached: bool) -> Bool[np.ndarray, "h w"]:
    """Pixels to be computed for a Gram matrix: mixed, or clear ones that nothing cached holds."""
    if cached:
        return reach.mixed
    return reach.mixed | beside_whole_cells(reach.clear, cell)


def _wanted(
    blocks: Sequence[Sequence[str]],
    seen: Mapping[str, Reach],
    cells: Mapping[str, int],
    cached: Mapping[str, bool],
) -> dict[str, tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]]:
    """Of every map the pixels needed, and those of them to be computed, from the last one back."""
    found: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    names = maps_of(blocks)
    need = np.zeros_like(seen[names[-1]].clear)
    for name, before in zip(reversed(names), [*reversed(names[:-1]), ""], strict=True):
        reach, pooled = seen[name], name.startswith("pool")
        if name in cells:
            need = need | _counted(reach, cells[name], cached[name])
        computed = need & (reach.mixed if cached.get(name, pooled) else ~reach.blank)
        found[name] = need, computed
        if not before:
            break
        if pooled:
            fresh = computed.repeat(2, axis=0).repeat(2, axis=1)
            need = np.zeros_like(seen[before].clear)
            need[: fresh.shape[0], : fresh.shape[1]] = fresh
        else:
            need = binary_dilation(computed, _SQUARE)
    return found


def _patches(
    computed: Bool[np.ndarray, "h w"], rows: Int[np.ndarray, "p"], tiled: bool
) -> tuple[Int[np.ndarray, "s t"], Int[np.ndarray, "q"]]:
    """Sources of a layer's computed pixels, and the places of its rows (-1: outside the map)."""
    height, width = computed.shape
    y, x = covering_tiles(computed) if tiled else np.nonzero(computed)
    offsets = np.arange(-1, (TILE if tiled else 1) + 1)
    patch_y = (y[None, None] + offsets[:, None, None]) + 0 * offsets[None, :, None]
    patch_x = (x[None, None] + offsets[None, :, None]) + 0 * offsets[:, None, None]
    inside = (patch_y >= 0) & (patch_y < height) & (patch_x >= 0) & (patch_x < width)
    place = np.where(inside, patch_y * width + patch_x, -1)
    sources = np.where(inside, rows[np.maximum(place, 0)], 0)
    return sources.reshape(len(offsets) ** 2, -1), place[1:-1, 1:-1].reshape(-1)


def _pooling(
    computed: Bool[np.ndarray, "h w"], rows: Int[np.ndarray, "p"], above: int
) -> tuple[Int[np.ndarray, "4 t"], Int[np.ndarray, "t"]]:
    """The same for the pooled pixels of a block's input; ``above``: width of the map before."""
    places = np.flatnonzero(computed)
    y, x = np.divmod(places, computed.shape[1])
    corners = [(2 * y + dy) * above + 2 * x + dx for dy in (0, 1) for dx in (0, 1)]
    if not len(places):
        return np.zeros((4, 0), np.intp), places
    return np.stack([rows[corner] for corner in corners]), places


def blank_place(
    places: Int[np.ndarray, "n"], shape: tuple[int, ...], small: tuple[int, int]
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
