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

from jaxface._types import Array, Bool, Float, Int
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


@partial(jax.jit, static_argnames=("height", "width", "cull"))
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
            jax.vmap(lambda v, i: v[i])(screen[..., k], faces[..., i]).reshape(-1) for i in range(3)
        )
        for k in range(3)
    )
    finite = jnp.isfinite(sum(x)) & jnp.isfinite(sum(y)) & jnp.isfinite(sum(z))
    drawable = finite & (z[0] > near) & (z[1] > near) & (z[2] > near)
    triangle = jnp.arange(scenes * count, dtype=jnp.int32)
    tiles = Tiles(x, y, z, *pixel_block(x, y, drawable, height, width), triangle // count, triangle)
    pixels = scenes * height * width
    buffer = Buffer(jnp.full((pixels,), jnp.inf, x[0].dtype), jnp.full((pixels,), NONE, jnp.int32))
    buffer, rest = _draw(buffer, tiles, _bits(tiles, cull), ROUNDS, height, width)

    # Few-fragment tiles first: a batch takes as many rounds as its fullest tile.
    large = (tiles.columns > TILE_COLUMNS) | (tiles.rows > TILE_ROWS)
    few = ~large & (jax.lax.population_count(rest) <= ROUNDS)
    first, second = _running_count(few & (rest != 0)), _running_count(~few)
    length = first[-1] + second[-1]
    place = jnp.where(few, jnp.where(rest != 0, first - 1, length), first[-1] + second - 1)
    place = jnp.where(place < length, place, scenes * count + BATCH)
    queue = jnp.zeros((scenes * count + BATCH,), jnp.int32).at[place].set(triangle, mode="drop")

    def draw_batch(state):
        cursor, done, buffer = state
        window = jax.lax.dynamic_slice(queue, (cursor,), (BATCH,))
        slot = jnp.arange(BATCH, dtype=jnp.int32)
        box = jax.tree.map(lambda v: v[window], tiles)
        across = -(-box.columns // TILE_COLUMNS)
        skip = jnp.where(rest[window] != 0, 0, 1)
        wanted = across * -(-box.rows // TILE_ROWS) - skip
        left_over = jnp.where(cursor + slot < length, wanted, 0).at[0].add(-done)
        left_over = jnp.minimum(left_over, BATCH + 1)  # so that the sum cannot overflow
        ends = jnp.cumsum(left_over, dtype=jnp.int32)
        starts = ends - left_over
        mark = jnp.zeros((BATCH,), jnp.int32)
        mark = mark.at[starts].add((left_over > 0).astype(jnp.int32), mode="drop")
        owner = jnp.cumsum(mark, dtype=jnp.int32) - 1
        live = slot < ends[-1]
        tile = slot - starts[owner] + jnp.where(owner == 0, done, 0) + skip[owner]
        shift_x = tile % jnp.maximum(across[owner], 1) * TILE_COLUMNS
        shift_y = tile // jnp.maximum(across[owner], 1) * TILE_ROWS
        here = jax.tree.map(lambda v: v[window[owner]], tiles)
        here = here._replace(
            left=here.left + shift_x,
            top=here.top + shift_y,
            columns=jnp.where(live, here.columns - shift_x, 0),
            rows=here.rows - shift_y,
        )
        bits = jnp.where(tile == 0, jnp.where(live, rest[here.triangle], 0), _bits(here, cull))
        buffer, _ = _draw(buffer, here, bits, TILE_PIXELS, height, width)
        finished = jnp.sum(ends <= BATCH, dtype=jnp.int32)
        begun = jnp.where(finished == 0, done + BATCH, BATCH - starts[finished])
        return cursor + finished, jnp.where(finished < BATCH, begun, 0), buffer

    start = (jnp.int32(0), jnp.int32(0), buffer)
    *_, buffer = jax.lax.while_loop(lambda state: state[0] < length, draw_batch, start)
    nearest = jnp.where(buffer.triangle == NONE, -1, buffer.triangle % count)
    return nearest.reshape(scenes, height, width)


def _bits(tiles: Tiles, cull: bool) -> Int[Array, "t"]:
    return tile_bits(tiles.x, tiles.y, tiles.left, tiles.top, tiles.columns, tiles.rows, cull)


def _running_count(flags: Bool[Array, "t"]) -> Int[Array, "t"]:
    """How many flags are set up to and with each: a prefix sum in two levels.

    Blocks are summed by a triangular matrix, since XLA's own prefix sum takes longer on a CPU than
    all the drawing; zeros and ones are exact in any precision of multiplication.
    """
    blocks = jnp.pad(flags, (0, -flags.size % 128)).reshape(-1, 128).astype(jnp.float32)
    inner = blocks @ jnp.triu(jnp.ones((128, 128), jnp.float32))
    inner = inner.astype(jnp.int32)
    before = jnp.cumsum(inner[:, -1], dtype=jnp.int32) - inner[:, -1]
    return (inner + before[:, None]).reshape(-1)[: flags.size]


def _draw(
    buffer: Buffer, tiles: Tiles, bits: Int[Array, "t"], rounds: int, height: int, width: int
) -> tuple[Buffer, Int[Array, "t"]]:
    """The first ``rounds`` fragments of each tile into the buffer, and the bits not drawn."""
    pixels = buffer.depth.shape[0]

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
