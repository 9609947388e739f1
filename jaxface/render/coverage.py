"""Which pixel centres a triangle covers: the edge test, exact bookkeeping, small tiles as bits.

A centre belongs to a triangle when it lies inside, or on a *top* or *left* edge (the usual fill
rule), so of two triangles on either side of a shared edge exactly one takes a centre on it. The
test for an edge from a to b compares two rounded products of coordinates relative to the centre,
``a_x b_y`` with ``a_y b_x``. Written from b to a it compares the same two numbers, so both
triangles of an edge always decide in opposite ways, whatever the rounding and however a
compiler contracts multiplications and additions: no cracks, no double cover.

Corners are triples of arrays, ``x[i]`` the x coordinates (px) of corner i of every triangle.
"""

import jax.numpy as jnp

from jaxface._types import Array, Bool, Float, Int

TILE_PIXELS = 30
"""pixels of a tile: its coverage fits an int32"""

Corners = tuple[Array, Array, Array]


def top_left(x: Corners, y: Corners, i: int) -> Bool[Array, "..."]:
    """Whether the edge from corner i to the next is a top or left one.

    So for a triangle that runs clockwise on the screen (y down); negate for the other winding.
    """
    j = (i + 1) % 3
    return (y[j] < y[i]) | ((y[j] == y[i]) & (x[j] > x[i]))


def pixel_block(
    x: Corners, y: Corners, drawable: Bool[Array, "..."], height: int, width: int
) -> tuple[Array, Array, Array, Array]:
    """First column, first row, columns and rows of the pixel centres in the bounding boxes.

    Counts are zero for triangles that are not drawable, are off the image or have no extent.
    """
    low_x, high_x = jnp.minimum(jnp.minimum(*x[:2]), x[2]), jnp.maximum(jnp.maximum(*x[:2]), x[2])
    low_y, high_y = jnp.minimum(jnp.minimum(*y[:2]), y[2]), jnp.maximum(jnp.maximum(*y[:2]), y[2])
    drawable = drawable & (low_x < high_x) & (low_y < high_y)
    # Clipped as floats, since coordinates of far triangles overflow integers.
    first_x = jnp.clip(jnp.ceil(low_x - 0.5), 0, width)
    first_y = jnp.clip(jnp.ceil(low_y - 0.5), 0, height)
    columns = jnp.clip(jnp.floor(high_x - 0.5), -1, width - 1) - first_x + 1
    rows = jnp.clip(jnp.floor(high_y - 0.5), -1, height - 1) - first_y + 1
    drawable = drawable & (columns > 0) & (rows > 0)
    block = [
        jnp.where(drawable, value, 0).astype(jnp.int32)
        for value in (first_x, first_y, columns, rows)
    ]
    return block[0], block[1], block[2], block[3]


def surely_behind(x: Corners, y: Corners) -> Bool[Array, "..."]:
    """Triangles that run clockwise on the screen beyond rounding; slivers are left in doubt."""
    one, other = (x[1] - x[0]) * (y[2] - y[0]), (y[1] - y[0]) * (x[2] - x[0])
    return one - other > 1e-5 * (jnp.abs(one) + jnp.abs(other))


def tile_shape(
    columns: Int[Array, "..."], rows: Int[Array, "..."]
) -> tuple[Int[Array, "..."], Int[Array, "..."]]:
    """Columns and rows of the tiles that a block is cut into: one tile wherever that can hold it.

    Blocks too large for one are cut into tiles of 6 to 10 columns, which waste few bits.
    """
    columns = jnp.maximum(columns, 1).astype(jnp.float32)
    widest = jnp.maximum(10.0, jnp.floor(TILE_PIXELS / jnp.maximum(rows, 1).astype(jnp.float32)))
    wide = jnp.ceil(columns / jnp.ceil(columns / widest))
    return wide.astype(jnp.int32), jnp.floor(TILE_PIXELS / wide).astype(jnp.int32)


def tile_bits(
    x: Corners,
    y: Corners,
    left: Int[Array, "..."],
    top: Int[Array, "..."],
    columns: Int[Array, "..."],
    rows: Int[Array, "..."],
    wide: Int[Array, "..."],
    cull: bool,
) -> Int[Array, "..."]:
    """Coverage of one tile of each triangle, as bits.

    Bit ``r * wide + c`` is the pixel centre r rows below and c right of the tile's first pixel.

    Args:
        x: columns of the corners, px.
        y: rows of the corners, px.
        left: column of the tile's first pixel.
        top: its row.
        columns: columns of the block from the tile's first pixel on, perhaps more than the tile's.
        rows: rows likewise.
        wide: columns of the tile.
        cull: leave out triangles that run clockwise on the screen, those seen from behind.
    """
    dtype = x[0].dtype
    start, cy = left.astype(dtype) + 0.5, top.astype(dtype) + 0.5
    past_block, past_tile = start + columns.astype(dtype), start + wide.astype(dtype)
    bottom = cy + rows.astype(dtype)
    edges = []
    for i in range(3):
        j = (i + 1) % 3
        keep = top_left(x, y, i)
        # Turned so that every edge is a top-left one, a tie always counts as inside.
        ax, ay = jnp.where(keep, x[i], x[j]), jnp.where(keep, y[i], y[j])
        bx, by = jnp.where(keep, x[j], x[i]), jnp.where(keep, y[j], y[i])
        edges.append((keep, ax, ay, bx, by))
    sides = [jnp.zeros_like(columns) for _ in edges]
    block = jnp.zeros_like(columns)
    cx = start
    for bit in range(TILE_PIXELS):
        for i, (_, ax, ay, bx, by) in enumerate(edges):
            inside = (ax - cx) * (by - cy) >= (ay - cy) * (bx - cx)
            sides[i] = sides[i] | jnp.where(inside, 1 << bit, 0)
        block = block | jnp.where((cx < past_block) & (cy < bottom), 1 << bit, 0)
        cx = cx + 1.0
        wrap = cx >= past_tile
        cx, cy = jnp.where(wrap, start, cx), jnp.where(wrap, cy + 1.0, cy)
    sides = [jnp.where(keep, side, ~side) for (keep, *_), side in zip(edges, sides, strict=True)]
    covered = ~(sides[0] | sides[1] | sides[2])
    if not cull:
        covered = covered | (sides[0] & sides[1] & sides[2])
    return covered & block


def inverse_depth_at(
    x: Corners, y: Corners, inverse: Corners, cx: Float[Array, "..."], cy: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Inverse depth (1/mm) of covering triangles at the pixel centres (cx, cy).

    A convex combination of the corners' inverse depths, by weights that are magnitudes of the
    edge functions, so a sliver's rounding cannot take it outside its corners'.
    """
    rx, ry = [v - cx for v in x], [v - cy for v in y]
    total, weighted = 0.0, 0.0
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        weight = jnp.abs(rx[j] * ry[k] - ry[j] * rx[k])
        total = total + weight
        weighted = weighted + weight * inverse[i]
    return jnp.where(total > 0, weighted / jnp.where(total > 0, total, 1.0), inverse[0])
