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

from jaxface._types import Array, Bool, Int

TILE_ROWS = 5
TILE_COLUMNS = 6
TILE_PIXELS = TILE_ROWS * TILE_COLUMNS
"""a tile's coverage fits an int32"""

Corners = tuple[Array, Array, Array]


def top_left(x: Corners, y: Corners, i: int) -> Bool[Array, "..."]:
    """Whether the edge from corner i to the next is a top or left one, for a triangle that runs
    clockwise on the screen (y down); for the other winding it is the negation."""
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
    block = first_x, first_y, jnp.where(drawable, columns, 0), jnp.where(drawable, rows, 0)
    return tuple(jnp.where(jnp.isnan(b), 0, b).astype(jnp.int32) for b in block)


def tile_bits(
    x: Corners,
    y: Corners,
    first_x: Int[Array, "..."],
    first_y: Int[Array, "..."],
    columns: Int[Array, "..."],
    rows: Int[Array, "..."],
    cull: bool,
) -> Int[Array, "..."]:
    """Coverage of one tile of each triangle: bit ``r * TILE_COLUMNS + c`` is the centre r rows
    below and c columns right of the tile's first pixel.

    Args:
        x: columns of the corners, px.
        y: rows of the corners, px.
        first_x: column of the tile's first pixel.
        first_y: its row.
        columns: columns of the block from the tile's first pixel on; more than a tile's is fine.
        rows: rows likewise.
        cull: leave out triangles that run clockwise on the screen, those seen from behind.
    """
    left, top = first_x.astype(x[0].dtype) + 0.5, first_y.astype(x[0].dtype) + 0.5
    sides = []
    for i in range(3):
        j = (i + 1) % 3
        keep = top_left(x, y, i)
        # Turned so that every edge is a top-left one, a tie always counts as inside.
        ax, ay = jnp.where(keep, x[i], x[j]), jnp.where(keep, y[i], y[j])
        bx, by = jnp.where(keep, x[j], x[i]), jnp.where(keep, y[j], y[i])
        bits = jnp.zeros_like(columns)
        for r in range(TILE_ROWS):
            for c in range(TILE_COLUMNS):
                cx, cy = left + c, top + r
                inside = (ax - cx) * (by - cy) >= (ay - cy) * (bx - cx)
                bits = bits | jnp.where(inside, 1 << (r * TILE_COLUMNS + c), 0)
        sides.append(jnp.where(keep, bits, ~bits))
    covered = ~(sides[0] | sides[1] | sides[2])
    if not cull:
        covered = covered | (sides[0] & sides[1] & sides[2])
    every_row = sum(1 << (r * TILE_COLUMNS) for r in range(TILE_ROWS))
    in_columns = ((1 << jnp.clip(columns, 0, TILE_COLUMNS)) - 1) * every_row
    in_rows = (1 << (TILE_COLUMNS * jnp.clip(rows, 0, TILE_ROWS))) - 1
    return covered & in_columns & in_rows


def depth_at(x: Corners, y: Corners, z: Corners, cx: Array, cy: Array) -> Array:
    """Depth (mm) of covering triangles at the pixel centres (cx, cy).

    The inverse depth is a convex combination of the corners', by weights that are magnitudes of
    the edge functions, so a sliver's rounding cannot take the depth outside its corners'. No
    product here is directly added to anything, so no compiler can contract one into a fused
    multiply-add: the same fragment has bitwise the same depth wherever it is evaluated.
    """
    rx, ry = [v - cx for v in x], [v - cy for v in y]
    weights = []
    for j, k in ((1, 2), (2, 0), (0, 1)):
        one, other = rx[j] * ry[k], ry[j] * rx[k]
        weights.append(jnp.maximum(one, other) - jnp.minimum(one, other))
    total = weights[0] + weights[1] + weights[2]
    inverse = weights[0] / z[0] + weights[1] / z[1] + weights[2] / z[2]
    return jnp.where(inverse > 0, total / jnp.where(inverse > 0, inverse, 1.0), z[0])
