"""The z-buffer: which triangle is nearest at each pixel.

Two passes over fragments settle a pixel without packing depth and index in one word: a
scatter-min of the depth, then a scatter-min of the index among fragments that have exactly that
depth. The art is to have few fragments, and none that miss:

1. The coverage of the tile at the corner of each triangle's bounding box is computed at once, as
   the bits of an integer. Rounds hand one bit a triangle to the z-buffer, ``ROUNDS`` at most,
   which serves nearly all triangles of a fine mesh.
2. What that leaves (a tile with more covered centres, boxes larger than a tile) is listed,
   compacted, and drawn in batches of tiles by a loop that ends when the list does. A triangle
   of any size is right, memory is bounded, and no capacity can be exceeded.

Rounds are loops rather than unrolled because a loop's operands are stored: XLA would otherwise
fuse the coverage into, and so repeat it for, every one of its uses.

A batch of scenes is drawn as one scene with one longer buffer, so ``vmap`` adds no selects.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxface._types import Array, Float, Int
from jaxface.render.coverage import (
    TILE_COLUMNS,
    TILE_PIXELS,
    TILE_ROWS,
    Corners,
    depth_at,
    pixel_block,
    tile_bits,
)

ROUNDS = 4
"""fragments a triangle that are drawn before the rest is compacted"""
BATCH = 8192
"""tiles drawn per iteration of the loop over the rest"""
NONE = jnp.iinfo(jnp.int32).max


class Tiles(NamedTuple):
    """Tiles to draw, each with the triangle whose fragments in it count."""

    x: Corners
    y: Corners
    z: Corners
    left: Int[Array, "t"]
    """column of the tile's first pixel"""
    top: Int[Array, "t"]
    """row of the tile's first pixel"""
    columns: Int[Array, "t"]
    """columns of the triangle's bounding box from there on"""
    rows: Int[Array, "t"]
    scene: Int[Array, "t"]
    triangle: Int[Array, "t"]


class Buffer(NamedTuple):
    """Nearest depth (mm, inf for none) and its triangle (NONE for none) at every pixel."""

    depth: Float[Array, "p"]
    triangle: Int[Array, "p"]


@partial(jax.jit, static_argnames=("height", "width", "cull", "near"))
def nearest_triangles(
    screen: Float[Array, "b n 3"],
    faces: Int[Array, "b f 3"],
    height: int,
    width: int,
    cull: bool,
    near: float,
) -> Int[Array, "b h w"]:
    """Index of the nearest triangle at each pixel of each scene, -1 where there is none."""
    scenes, count = faces.shape[:2]
    x, y, z = (
        tuple(
            jax.vmap(lambda v, i: v[i])(screen[..., k], faces[..., i]).reshape(-1)
            for i in range(3)
        )
        for k in range(3)
    )
    finite = jnp.isfinite(sum(x)) & jnp.isfinite(sum(y)) & jnp.isfinite(sum(z))
    drawable = finite & (z[0] > near) & (z[1] > near) & (z[2] > near)
    triangle = jnp.arange(scenes * count, dtype=jnp.int32)
    tiles = Tiles(
        x, y, z, *pixel_block(x, y, drawable, height, width), triangle // count, triangle
    )
    pixels = scenes * height * width
    buffer = Buffer(
        jnp.full((pixels,), jnp.inf, x[0].dtype), jnp.full((pixels,), NONE, jnp.int32)
    )
    buffer, rest = _draw(buffer, tiles, ROUNDS, height, width, cull)

    # The first tile is drawn again if bits were left: a fragment twice does no harm.
    across = -(-tiles.columns // TILE_COLUMNS)
    skip = jnp.where(rest != 0, 0, 1)
    wanted = jnp.maximum(across * -(-tiles.rows // TILE_ROWS) - skip, 0)
    rank = jax.lax.associative_scan(jnp.add, (wanted > 0).astype(jnp.int32))
    queue = jnp.zeros((scenes * count + BATCH,), jnp.int32)
    queue = queue.at[jnp.where(wanted > 0, rank - 1, queue.size)].set(triangle, mode="drop")
    length = rank[-1]

    def draw_batch(state):
        cursor, done, buffer = state
        window = jax.lax.dynamic_slice(queue, (cursor,), (BATCH,))
        slot = jnp.arange(BATCH, dtype=jnp.int32)
        left_over = jnp.where(cursor + slot < length, wanted[window], 0).at[0].add(-done)
        left_over = jnp.minimum(left_over, BATCH + 1)  # so that the sum cannot overflow
        ends = jnp.cumsum(left_over, dtype=jnp.int32)
        starts = ends - left_over
        mark = jnp.zeros((BATCH,), jnp.int32)
        mark = mark.at[starts].add((left_over > 0).astype(jnp.int32), mode="drop")
        owner = jnp.cumsum(mark, dtype=jnp.int32) - 1
        t = window[owner]
        tile = slot - starts[owner] + jnp.where(owner == 0, done, 0) + skip[t]
        shift_x = tile % jnp.maximum(across[t], 1) * TILE_COLUMNS
        shift_y = tile // jnp.maximum(across[t], 1) * TILE_ROWS
        here = jax.tree.map(lambda v: v[t], tiles)
        here = here._replace(
            left=here.left + shift_x,
            top=here.top + shift_y,
            columns=jnp.where(slot < ends[-1], here.columns - shift_x, 0),
            rows=here.rows - shift_y,
        )
        buffer, _ = _draw(buffer, here, TILE_PIXELS, height, width, cull)
        finished = jnp.sum(ends <= BATCH, dtype=jnp.int32)
        begun = jnp.where(finished == 0, done + BATCH, BATCH - starts[finished])
        return cursor + finished, jnp.where(finished < BATCH, begun, 0), buffer

    start = (jnp.int32(0), jnp.int32(0), buffer)
    *_, buffer = jax.lax.while_loop(lambda state: state[0] < length, draw_batch, start)
    nearest = jnp.where(buffer.triangle == NONE, -1, buffer.triangle % count)
    return nearest.reshape(scenes, height, width)


def _draw(
    buffer: Buffer, tiles: Tiles, rounds: int, height: int, width: int, cull: bool
) -> tuple[Buffer, Int[Array, "t"]]:
    """The first ``rounds`` fragments of each tile into the buffer, and the bits not drawn."""
    pixels = buffer.depth.shape[0]
    bits = tile_bits(
        tiles.x, tiles.y, tiles.left, tiles.top, tiles.columns, tiles.rows, cull
    )

    def fragment(rest):
        place = jax.lax.population_count((rest & -rest) - 1)
        row = sum((place >= r * TILE_COLUMNS).astype(jnp.int32) for r in range(1, TILE_ROWS))
        px, py = tiles.left + place - row * TILE_COLUMNS, tiles.top + row
        at = jnp.where(rest != 0, (tiles.scene * height + py) * width + px, pixels)
        dtype = buffer.depth.dtype
        return at, depth_at(*tiles[:3], px.astype(dtype) + 0.5, py.astype(dtype) + 0.5)

    def going(state):
        turn, rest, _ = state
        return (turn < rounds) & jnp.any(rest != 0)

    def lower(state):
        turn, rest, depth = state
        at, d = fragment(rest)
        return turn + 1, rest & (rest - 1), depth.at[at].min(d, mode="drop")

    def claim(state):
        turn, rest, triangle = state
        at, d = fragment(rest)
        won = d == depth.at[at].get(mode="fill", fill_value=-1.0)
        at = jnp.where(won, at, pixels)
        return turn + 1, rest & (rest - 1), triangle.at[at].min(tiles.triangle, mode="drop")

    first = jnp.int32(0)
    _, rest, depth = jax.lax.while_loop(going, lower, (first, bits, buffer.depth))
    triangle = jnp.where(depth < buffer.depth, NONE, buffer.triangle)
    *_, triangle = jax.lax.while_loop(going, claim, (first, bits, triangle))
    return Buffer(depth, triangle), rest
