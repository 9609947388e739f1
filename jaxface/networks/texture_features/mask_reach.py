"""Which responses of a network a mask changes, and what must be computed again to know them.

A response whose receptive field is all visible is that of the unmasked image; one whose receptive
field is all masked is that of a constant image. Between the two lies a band along the mask's
outline, the wider the deeper the layer: one pixel more on either side for every 3x3 convolution.
Only the band is computed again, layer by layer; around it stand cached responses of the texture
and those of the constant image.

Everything here depends on the mask and the network's shape alone, not on an image.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxface._types import Bool, Int
from jaxface.networks.convolution.winograd import TILE

PYRAMID = 4
"""levels of a pyramid of cells, each twice as wide as the one before"""


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

    Row 0 is zero. The rows computed from those of the table before follow, then rows of the
    constant image, then cached ones. Maps are the layers, and each block's input ``poolB``. A
    block's last layer has no table where it is wanted for its pooling alone: tiles are pooled as
    they are made.
    """

    name: str
    layer: str
    """the convolution that makes the computed rows, or none"""
    sources: Int[np.ndarray, "t s"]
    """rows of the table before: 36 of a 6x6 patch for each tile of 4x4 pixels, 9 for each single
    pixel, or the 4 of a pooled one; 0 for the image itself"""
    pixels: int
    """computed rows, one after the other, for each row of sources: 16 of a tile, 4 of one that is
    pooled, or 1"""
    blank: Int[np.ndarray, "a"]
    """places in the constant image's map"""
    cached: Int[np.ndarray, "b"]
    """places in the texture's map"""
    counted: Int[np.ndarray, "m"]
    """rows, all computed ones, that count in the layer's Gram matrix"""

    @property
    def computed(self) -> int:
        """Number of computed rows."""
        return len(self.sources) * self.pixels

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
            clear, blank = _all_around(clear), _all_around(blank)
        found[name] = Reach(clear, blank)
    return found


def _all_around(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Where a pixel and its eight neighbours, as far as there are any, are true."""
    rows = mask.copy()
    rows[1:] &= mask[:-1]
    rows[:-1] &= mask[1:]
    found = rows.copy()
    found[:, 1:] &= rows[:, :-1]
    found[:, :-1] &= rows[:, 1:]
    return found


def _any_around(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Where a pixel or one of its eight neighbours is true."""
    return ~_all_around(~mask)


def _all_of_cell(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h2 w2"]:
    height, width = (side // 2 * 2 for side in mask.shape)
    rows = mask[0:height:2, :width] & mask[1:height:2, :width]
    return rows[:, ::2] & rows[:, 1::2]


def whole_cells(mask: Bool[np.ndarray, "h w"], cell: int) -> Bool[np.ndarray, "a b"]:
    """Which square cells of a map are true throughout; the last may hang over its edge."""
    height, width = mask.shape
    padded = np.pad(mask, ((0, -height % cell), (0, -width % cell)), constant_values=True)
    rows, columns = padded.shape[0] // cell, padded.shape[1] // cell
    # One axis after the other: NumPy is ten times slower at both at once.
    strips = np.all(padded.reshape(rows, cell, -1), axis=1)
    return np.asarray(np.all(strips.reshape(rows, columns, cell), axis=2))


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
    """
    seen = reaches(blocks, visible)
    made_by = _convolutions(blocks, cells, tiled)
    wanted = _wanted(made_by, seen, cells, cached)
    tables: list[Table] = []
    rows, width = np.zeros(0, np.intp), 0
    for name, layer in made_by.items():
        reach, (need, computed) = seen[name], wanted[name]
        if not layer:
            sources, places = _pooling(computed, rows, width)
        elif layer == name:
            sources, places = _patches(computed, rows, tiled[name])
        else:
            sources, places = _pooled_patches(_pooled_cells(computed, seen[layer]), rows)
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
            counted = np.sort(rows[np.flatnonzero(_counted(reach, cells[name], cached[name]))])
        pixels = places.size // max(1, len(sources))
        tables.append(Table(name, layer, sources, pixels, blank, whole, counted))
    return Plan(tuple(tables), {name: seen[name] for name in cells})


def _convolutions(
    blocks: Sequence[Sequence[str]], wanted: Iterable[str], tiled: Mapping[str, bool]
) -> dict[str, str]:
    """The maps to be made, in order, and the layer that makes each from the one before."""
    made_by = {name: "" if name.startswith("pool") else name for name in maps_of(blocks)}
    for index, block in enumerate(blocks[:-1], start=1):
        last = block[-1]
        if last not in wanted and tiled[last]:
            del made_by[last]
            made_by[f"pool{index}"] = last
    return made_by


def _counted(reach: Reach, cell: int, cached: bool) -> Bool[np.ndarray, "h w"]:
    """Pixels to be computed for a Gram matrix: mixed, or clear ones that nothing cached holds."""
    if cached:
        return reach.mixed
    return reach.mixed | beside_whole_cells(reach.clear, cell)


def _wanted(
    made_by: Mapping[str, str],
    seen: Mapping[str, Reach],
    cells: Mapping[str, int],
    cached: Mapping[str, bool],
) -> dict[str, tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]]:
    """Of every map the pixels needed, and those of them to be computed, from the last one back."""
    found: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    names = list(made_by)
    need = np.zeros_like(seen[names[-1]].clear)
    for name, before in zip(reversed(names), [*reversed(names[:-1]), ""], strict=True):
        reach, layer = seen[name], made_by[name]
        if name in cells:
            need = need | _counted(reach, cells[name], cached[name])
        computed = need & (reach.mixed if cached.get(name, layer != name) else ~reach.blank)
        found[name] = need, computed
        if not before:
            break
        if layer == name:
            need = _any_around(computed)
        else:
            need = _pooled_cells(computed, seen[layer or before])
            need = _any_around(need) if layer else need
    return found


def _pooled_cells(pooled: Bool[np.ndarray, "h2 w2"], above: Reach) -> Bool[np.ndarray, "h w"]:
    """The pixels of the map above that pooled ones are made of."""
    fresh = pooled.repeat(2, axis=0).repeat(2, axis=1)
    found = np.zeros_like(above.clear)
    found[: fresh.shape[0], : fresh.shape[1]] = fresh
    return found


def _patches(
    computed: Bool[np.ndarray, "h w"], rows: Int[np.ndarray, "p"], tiled: bool
) -> tuple[Int[np.ndarray, "t s"], Int[np.ndarray, "q"]]:
    """Sources of a layer's computed pixels, and the places of its rows (-1: outside the map)."""
    y, x = covering_tiles(computed) if tiled else np.nonzero(computed)
    place = _places_around(y, x, TILE if tiled else 1, computed.shape)
    return _sources(place, rows), place[:, 1:-1, 1:-1].reshape(-1)


def _pooled_patches(
    computed: Bool[np.ndarray, "h w"], rows: Int[np.ndarray, "p"]
) -> tuple[Int[np.ndarray, "t 36"], Int[np.ndarray, "q"]]:
    """Sources of tiles that are pooled, and the places of their 2x2 pooled pixels.

    Args:
        computed: whole cells of 2x2 pixels, so that every tile begins with one.
        rows: of the pixels of the map before.
    """
    y, x = covering_tiles(computed)
    half = (computed.shape[0] // 2, computed.shape[1] // 2)
    pooled = _places_around(y // 2, x // 2, TILE // 2, half)[:, 1:-1, 1:-1]
    return _sources(_places_around(y, x, TILE, computed.shape), rows), pooled.reshape(-1)


def _sources(
    place: Int[np.ndarray, "t s s"], rows: Int[np.ndarray, "p"]
) -> Int[np.ndarray, "t ss"]:
    """Rows of places; row 0 outside the map."""
    found = np.where(place >= 0, rows[np.maximum(place, 0)], 0)
    return found.reshape(len(place), place.shape[1] ** 2)


def _places_around(
    y: Int[np.ndarray, "t"], x: Int[np.ndarray, "t"], side: int, shape: tuple[int, ...]
) -> Int[np.ndarray, "t s s"]:
    """Places of square tiles' pixels, and of those one pixel around (-1: outside the map)."""
    offsets = np.arange(-1, side + 1)
    rows = (y[:, None] + offsets)[:, :, None]
    columns = (x[:, None] + offsets)[:, None]
    inside = (rows >= 0) & (rows < shape[0]) & (columns >= 0) & (columns < shape[1])
    return np.where(inside, rows * shape[1] + columns, -1)


def _pooling(
    computed: Bool[np.ndarray, "h w"], rows: Int[np.ndarray, "p"], above: int
) -> tuple[Int[np.ndarray, "t 4"], Int[np.ndarray, "t"]]:
    """The same for the pooled pixels of a block's input; ``above``: width of the map before."""
    places = np.flatnonzero(computed)
    y, x = np.divmod(places, computed.shape[1])
    corners = [(2 * y + dy) * above + 2 * x + dx for dy in (0, 1) for dx in (0, 1)]
    if not len(places):
        return np.zeros((0, 4), np.intp), places
    return np.stack([rows[corner] for corner in corners], axis=1), places


def covering_tiles(
    needed: Bool[np.ndarray, "h w"],
) -> tuple[Int[np.ndarray, "t"], Int[np.ndarray, "t"]]:
    """Tops and left edges of disjoint 4x4 tiles that cover the given pixels: few, not fewest.

    Strips of four rows are covered from the left, all at once, a tile each in turn.
    """
    height, width = needed.shape
    padded = np.pad(needed, ((0, -height % TILE), (0, 0))).reshape(-1, TILE, width)
    strips = np.asarray(np.any(padded, axis=1))
    ahead = np.where(strips, np.arange(width), width)
    ahead = np.minimum.accumulate(ahead[:, ::-1], axis=1)[:, ::-1]
    ahead = np.pad(ahead, ((0, 0), (0, TILE)), constant_values=width)  # the next column to cover
    every = np.arange(len(strips))
    lefts = [ahead[:, 0]]
    while np.any(lefts[-1] < width):
        lefts.append(ahead[every, np.minimum(lefts[-1] + TILE, width)])
    columns = np.stack(lefts, axis=1)
    strip, turn = np.nonzero(columns < width)
    return strip * TILE, columns[strip, turn]
