"""Rasterising a UV layout: which point of the surface every texel of a texture shows.

The layout depends on the topology alone, never on a shape or a photo, so it is computed once on
the host and used for every texture of that model.
"""

import hashlib
from collections import OrderedDict

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Bool, Float, Int

_CACHE: OrderedDict[tuple, "UVLayout"] = OrderedDict()
_CACHED_LAYOUTS = 3


class UVLayout(eqx.Module):
    """The surface point of each texel of an ``r x r`` texture, row 0 at the top.

    The texels of the gutter, a band around every chart, repeat the nearest texel of a chart, so
    a texture evaluated through the layout can be filtered across seams without dark rims.
    """

    triangle: Int[Array, "r r"]
    """index of the triangle the texel's centre lies in, -1 where there is none"""
    barycentric: Float[Array, "r r 2"]
    """weights of the triangle's second and third corner (the first has the rest of one)"""
    inside: Bool[Array, "r r"]
    """True inside the charts, False in the gutter and in the empty space"""
    area: Float[Array, "f"]
    """area of each triangle in the texture, texels"""

    @property
    def resolution(self) -> int:
        """Texels along a side."""
        return self.triangle.shape[0]

    def __call__(
        self, values: Float[Array, "n c"], faces: Int[Array, "f 3"], fill: float = 0.0
    ) -> Float[Array, "r r c"]:
        """Texture of a per-vertex quantity, linearly interpolated; ``fill`` in empty space."""
        first, second, third = (values[faces[:, corner]] for corner in range(3))
        triangle = jnp.maximum(self.triangle, 0)
        b, c = self.barycentric[..., :1], self.barycentric[..., 1:]
        texture = first[triangle] * (1 - b - c) + second[triangle] * b + third[triangle] * c
        return jnp.where(self.triangle[..., None] >= 0, texture, fill)


def uv_layout(
    uv: Float[Array, "m 2"],
    uv_faces: Int[Array, "f 3"],
    resolution: int,
    *,
    gutter: int = 8,
    tile: tuple[int, int] = (0, 0),
) -> UVLayout:
    """Rasterise a UV layout (origin bottom-left) into an ``r x r`` texture.

    A texel belongs to the triangle that holds its centre. Triangles that share an edge neither
    overlap along it nor leave a gap: both cut a row of texels at the very same number. Where
    charts overlap, the later triangle wins. The last few layouts are remembered by content.

    Args:
        uv: texture coordinates; one unit square is one texture.
        uv_faces: corners of the triangles in ``uv``.
        resolution: texels along a side.
        gutter: width of the band filled around the charts, texels.
        tile: (column, row) of the unit square wanted, for layouts spread over several (UDIM).

    Raises:
        ValueError: a shape, an index or the resolution is out of range, or ``uv`` is not finite.
    """
    coordinates = np.ascontiguousarray(uv, np.float64)
    corners = np.ascontiguousarray(uv_faces, np.int64)
    _check(coordinates, corners, resolution, gutter)
    content = hashlib.blake2b(coordinates.tobytes() + corners.tobytes()).digest()
    key = (content, resolution, gutter, tuple(tile))
    if key not in _CACHE:
        shifted = coordinates - np.asarray(tile, np.float64)
        # Texel centres at whole numbers; row 0 at the top.
        points = np.stack([shifted[:, 0], 1.0 - shifted[:, 1]], axis=1) * resolution - 0.5
        triangle, barycentric = _rasterize(points[corners], resolution)
        inside = triangle >= 0
        _fill_gutter(triangle, barycentric, gutter)
        _CACHE[key] = UVLayout(
            jnp.asarray(triangle),
            jnp.asarray(barycentric),
            jnp.asarray(inside),
            jnp.asarray(_areas(points[corners]), jnp.float32),
        )
        while len(_CACHE) > _CACHED_LAYOUTS:
            _CACHE.popitem(last=False)
    _CACHE.move_to_end(key)
    return _CACHE[key]


def seam_edges(
    faces: Int[Array, "f 3"], uv_faces: Int[Array, "f 3"]
) -> tuple[Int[Array, "s 2"], Int[Array, "s 2"]]:
    """Corner pairs in UV on the two sides of every seam: the same mesh edge, cut open.

    Returns:
        Two arrays of ``uv`` indices; row i of each is the same edge of the mesh (its two ends in
        the same order), seen from the two triangles that meet there.
    """
    mesh, texture = np.asarray(faces), np.asarray(uv_faces)
    following = [1, 2, 0]
    edges = np.stack([mesh, mesh[:, following]], axis=-1).reshape(-1, 2)
    ends = np.stack([texture, texture[:, following]], axis=-1).reshape(-1, 2)
    swap = edges[:, 0] > edges[:, 1]
    edges[swap], ends[swap] = edges[swap, ::-1], ends[swap, ::-1]
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, ends = edges[order], ends[order]
    same_edge = np.all(edges[1:] == edges[:-1], axis=1)
    cut = np.any(ends[1:] != ends[:-1], axis=1)
    at = np.flatnonzero(same_edge & cut)
    return jnp.asarray(ends[at]), jnp.asarray(ends[at + 1])


def _check(uv: np.ndarray, uv_faces: np.ndarray, resolution: int, gutter: int) -> None:
    if uv.ndim != 2 or uv.shape[1] != 2:
        raise ValueError(f"uv has shape {uv.shape}; it needs (m, 2)")
    if uv_faces.ndim != 2 or uv_faces.shape[1] != 3:
        raise ValueError(f"uv_faces has shape {uv_faces.shape}; it needs (f, 3) triangles")
    if not np.all(np.isfinite(uv)):
        raise ValueError("uv holds a NaN or an infinity; texture coordinates must be finite")
    if uv_faces.size and (uv_faces.min() < 0 or uv_faces.max() >= len(uv)):
        raise ValueError(
            f"uv_faces refers to {uv_faces.min()}..{uv_faces.max()}, but uv has {len(uv)} rows"
        )
    if not 1 <= resolution <= 16384:
        raise ValueError(f"resolution is {resolution}; it needs 1..16384 texels")
    if gutter < 0:
        raise ValueError(f"gutter is {gutter}; it needs a width of 0 texels or more")


def _areas(points: np.ndarray) -> np.ndarray:
    b, c = points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]
    return 0.5 * np.abs(b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])


def _rasterize(points: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Triangle index and two barycentric weights per texel, by spans of rows.

    Every triangle is cut into its rows, every row into a half-open span of texels; both steps
    expand all triangles at once.
    """
    triangle = np.full(size * size, -1, np.int32)
    barycentric = np.zeros((size * size, 2), np.float32)
    p = points[np.arange(len(points))[:, None], np.argsort(points[:, :, 1], axis=1, kind="stable")]
    (x0, y0), (x1, y1), (x2, y2) = (p[:, i].T for i in range(3))
    top = np.clip(np.ceil(y0), 0, size).astype(np.int64)
    bottom = np.clip(np.ceil(y2), 0, size).astype(np.int64)
    owner, row = _expand(top, bottom)
    # The long edge and, on its other side, the edge above or below the middle corner. An edge's
    # crossing is computed from its ends in order of y (ties: of x), alike from either triangle.
    y = row.astype(np.float64)
    upper = y < y1[owner]
    long_x = _crossing(x0[owner], y0[owner], x2[owner], y2[owner], y)
    short_x = np.where(
        upper,
        _crossing(x0[owner], y0[owner], x1[owner], y1[owner], y),
        _crossing(x1[owner], y1[owner], x2[owner], y2[owner], y),
    )
    left = np.clip(np.ceil(np.minimum(long_x, short_x)), 0, size).astype(np.int64)
    right = np.clip(np.ceil(np.maximum(long_x, short_x)), 0, size).astype(np.int64)
    first, edge_b, edge_c = points[:, 0], points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]
    area = edge_b[:, 0] * edge_c[:, 1] - edge_b[:, 1] * edge_c[:, 0]
    inverse = 1.0 / np.where(area == 0, np.inf, area)
    # Blocks of spans keep the temporaries small at any resolution.
    count = np.cumsum(np.maximum(right - left, 0))
    for block in _blocks(count, 1 << 20):
        span, column = _expand(left[block], right[block])
        index = owner[block][span]
        x, y_texel = column - first[index, 0], row[block][span] - first[index, 1]
        b = (x * edge_c[index, 1] - y_texel * edge_c[index, 0]) * inverse[index]
        c = (y_texel * edge_b[index, 0] - x * edge_b[index, 1]) * inverse[index]
        texel = row[block][span] * size + column
        triangle[texel] = index
        b = np.clip(b, 0.0, 1.0)
        barycentric[texel, 0], barycentric[texel, 1] = b, np.clip(c, 0.0, 1.0 - b)
    return triangle.reshape(size, size), barycentric.reshape(size, size, 2)


def _crossing(xa: np.ndarray, ya: np.ndarray, xb: np.ndarray, yb: np.ndarray, y: np.ndarray):
    rise = yb - ya
    along = (y - ya) / np.where(rise == 0, 1.0, rise)
    return xa + along * (xb - xa)


def _expand(start: np.ndarray, stop: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All integers of the ranges ``start[i]:stop[i]``, with the index i of their range."""
    length = np.maximum(stop - start, 0)
    owner = np.repeat(np.arange(len(start)), length)
    offset = np.arange(len(owner)) - np.repeat(np.cumsum(length) - length, length)
    return owner, start[owner] + offset


def _blocks(cumulative: np.ndarray, size: int) -> list[slice]:
    """Slices of consecutive ranges with about ``size`` integers each."""
    if not len(cumulative):
        return []
    cuts = np.searchsorted(cumulative, np.arange(size, cumulative[-1] + size, size)) + 1
    cuts = np.unique(np.concatenate([[0], np.minimum(cuts, len(cumulative)), [len(cumulative)]]))
    return [slice(a, b) for a, b in zip(cuts[:-1], cuts[1:], strict=True)]


def _fill_gutter(triangle: np.ndarray, barycentric: np.ndarray, width: int) -> None:
    """Grow the charts by ``width`` texels in place, each new texel a copy of a near one."""
    size = triangle.shape[0]
    flat, weights = triangle.reshape(-1), barycentric.reshape(-1, 2)
    edge = np.zeros(triangle.shape, bool)
    valid = triangle >= 0
    for axis in (0, 1):
        change = np.diff(valid, axis=axis)
        ahead, behind = [slice(None)] * 2, [slice(None)] * 2
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        edge[tuple(ahead)] |= change
        edge[tuple(behind)] |= change
    frontier = np.flatnonzero(edge & valid)
    sides = [(0, 1), (0, -1), (1, 0), (-1, 0)]
    diagonals = [(1, 1), (1, -1), (-1, 1), (-1, -1)]
    for step in range(width):
        # Four and eight neighbours in turn: an octagon, close to a disc.
        reached = []
        for down, right in sides + (diagonals if step % 2 else []):
            row, column = frontier // size + down, frontier % size + right
            within = (row >= 0) & (row < size) & (column >= 0) & (column < size)
            source, target = frontier[within], (row * size + column)[within]
            free = flat[target] < 0
            source, target = source[free], target[free]
            flat[target], weights[target] = flat[source], weights[source]
            reached.append(target)
        frontier = np.unique(np.concatenate(reached))
