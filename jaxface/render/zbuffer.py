"""The z-buffer: which triangle is nearest at each pixel.

Two passes over fragments settle a pixel without packing depth and index in one word: a
scatter-max of the inverse depth, then a scatter-min of the index among fragments that have exactly
that depth. The art is to have few fragments, and none that miss:

1. The coverage of a tile of 30 pixels, shaped to each triangle's bounding box, is computed at once,
   as the bits of an integer. Rounds hand one bit a triangle to the z-buffer, ``ROUNDS`` at most,
   which serves most triangles of a fine mesh.
2. What that leaves (more covered centres, boxes larger than a tile) is listed, compacted, and
   drawn in batches of tiles by a loop that ends when the list does. A triangle of any size is
   right, memory is bounded, and no capacity can be exceeded.

Rounds are loops rather than unrolled because a loop's operands are stored: XLA would otherwise
fuse the coverage into, and so repeat it for, every one of its uses.

A batch of scenes is drawn as one scene with one longer buffer, so ``vmap`` adds no selects.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxface._numerics import running_count
from jaxface._types import Array, Float, Int
from jaxface.render.coverage import (
    TILE_PIXELS,
    Corners,
    inverse_depth_at,
    pixel_block,
    surely_behind,
    tile_bits,
    tile_shape,
)

ROUNDS = 4
"""fragments a triangle that are drawn before the rest is compacted"""
BATCH = 8192
"""tiles drawn per iteration of the loop over the rest, more for large images"""
NONE = jnp.iinfo(jnp.int32).max


class Tiles(NamedTuple):
    """Tiles to draw, each with the triangle whose fragments in it count."""

    x: Corners
    y: Corners
    inverse: Corners
    """inverse depths of the corners, 1/mm"""
    left: Int[Array, "t"]
    """column of the tile's first pixel"""
    top: Int[Array, "t"]
    """row of the tile's first pixel"""
    columns: Int[Array, "t"]
    """columns of the triangle's bounding box from there on"""
    rows: Int[Array, "t"]
    wide: Int[Array, "t"]
    """columns of the tile"""
    scene: Int[Array, "t"]
    triangle: Int[Array, "t"]


class Buffer(NamedTuple):
    """Largest inverse depth (1/mm, 0 for none) and its triangle (or NONE) at every pixel."""

    inverse: Float[Array, "p"]
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
    inverse = tuple(1.0 / depth for depth in z)
    finite = jnp.isfinite(sum(x)) & jnp.isfinite(sum(y)) & jnp.isfinite(sum(inverse))
    drawable = finite & (z[0] > near) & (z[1] > near) & (z[2] > near)
    if cull:
        drawable = drawable & ~surely_behind(x, y)
    triangle = jnp.arange(scenes * count, dtype=jnp.int32)
    left, top, columns, rows = pixel_block(x, y, drawable, height, width)
    wide, high = tile_shape(columns, rows)
    tiles = Tiles(x, y, inverse, left, top, columns, rows, wide, triangle // count, triangle)
    pixels = scenes * height * width
    # Every batch passes over the whole image once, so large images get large batches.
    batch = max(BATCH, pixels // 32)
    buffer = Buffer(jnp.zeros((pixels,), x[0].dtype), jnp.full((pixels,), NONE, jnp.int32))
    buffer, rest = _draw(buffer, tiles, _bits(tiles, cull), ROUNDS, height, width)

    # Few-fragment tiles first: a batch takes as many rounds as its fullest tile.
    large = (columns > wide) | (rows > high)
    few = ~large & (jax.lax.population_count(rest) <= ROUNDS)
    first, second = running_count(jnp.stack([few & (rest != 0), ~few]))
    length = first[-1] + second[-1]
    place = jnp.where(few, jnp.where(rest != 0, first - 1, length), first[-1] + second - 1)
    place = jnp.where(place < length, place, scenes * count + batch)
    queue = jnp.zeros((scenes * count + batch,), jnp.int32).at[place].set(triangle, mode="drop")

    def draw_batch(state):
        cursor, done, buffer = state
        window = jax.lax.dynamic_slice(queue, (cursor,), (batch,))
        slot = jnp.arange(batch, dtype=jnp.int32)
        box = jax.tree.map(lambda v: v[window], tiles)
        high = jax.lax.div(jnp.full_like(box.wide, TILE_PIXELS), box.wide)
        across = jax.lax.div(box.columns + box.wide - 1, box.wide)
        skip = (rest[window] == 0).astype(jnp.int32)
        wanted = across * jax.lax.div(box.rows + high - 1, high) - skip
        left_over = jnp.where(cursor + slot < length, wanted, 0).at[0].add(-done)
        left_over = jnp.minimum(left_over, batch + 1)  # so that the sum cannot overflow
        ends = jnp.cumsum(left_over, dtype=jnp.int32)
        starts = ends - left_over
        mark = jnp.zeros((batch,), jnp.int32)
        mark = mark.at[starts].add((left_over > 0).astype(jnp.int32), mode="drop")
        owner = running_count(mark) - 1
        live = slot < ends[-1]
        tile = slot - starts[owner] + jnp.where(owner == 0, done, 0) + skip[owner]
        here = jax.tree.map(lambda v: v[window[owner]], tiles)
        shift_x = jax.lax.rem(tile, jnp.maximum(across[owner], 1)) * here.wide
        shift_y = jax.lax.div(tile, jnp.maximum(across[owner], 1)) * high[owner]
        here = here._replace(
            left=here.left + shift_x,
            top=here.top + shift_y,
            columns=jnp.where(live, here.columns - shift_x, 0),
            rows=here.rows - shift_y,
        )
        bits = jnp.where(tile == 0, jnp.where(live, rest[here.triangle], 0), _bits(here, cull))
        buffer, _ = _draw(buffer, here, bits, TILE_PIXELS, height, width)
        finished = jnp.sum(ends <= batch, dtype=jnp.int32)
        begun = jnp.where(finished == 0, done + batch, batch - starts[finished])
        return cursor + finished, jnp.where(finished < batch, begun, 0), buffer

    start = (jnp.int32(0), jnp.int32(0), buffer)
    *_, buffer = jax.lax.while_loop(lambda state: state[0] < length, draw_batch, start)
    nearest = jnp.where(buffer.triangle == NONE, -1, buffer.triangle % count)
    return nearest.reshape(scenes, height, width)


def _bits(tiles: Tiles, cull: bool) -> Int[Array, "t"]:
    return tile_bits(tiles.x, tiles.y, *tiles[3:8], cull)


def _draw(
    buffer: Buffer, tiles: Tiles, bits: Int[Array, "t"], rounds: int, height: int, width: int
) -> tuple[Buffer, Int[Array, "t"]]:
    """The first ``rounds`` fragments of each tile into the buffer, and the bits not drawn."""
    pixels, dtype = buffer.inverse.size, buffer.inverse.dtype

    def fragment(rest):
        place = jax.lax.population_count((rest & -rest) - 1)
        row = jnp.floor((place.astype(jnp.float32) + 0.5) / tiles.wide.astype(jnp.float32))
        row = row.astype(jnp.int32)
        px, py = tiles.left + place - row * tiles.wide, tiles.top + row
        at = jnp.where(rest != 0, (tiles.scene * height + py) * width + px, pixels)
        centre = px.astype(dtype) + 0.5, py.astype(dtype) + 0.5
        return at, inverse_depth_at(tiles.x, tiles.y, tiles.inverse, *centre)

    def going(state):
        turn, rest, *_ = state
        return (turn < rounds) & jnp.any(rest != 0)

    def approach(state):
        turn, rest, nearest, drawn = state
        at, inverse = fragment(rest)
        drawn = jax.tree.map(lambda all, one: all.at[turn].set(one), drawn, (at, inverse))
        return turn + 1, rest & (rest - 1), nearest.at[at].max(inverse, mode="drop"), drawn

    def claim(turn, triangle):
        at, inverse = (one[turn] for one in drawn)
        won = inverse == nearest.at[at].get(mode="fill", fill_value=-1.0)
        return triangle.at[jnp.where(won, at, pixels)].min(tiles.triangle, mode="drop")

    drawn = jnp.zeros((rounds, bits.size), jnp.int32), jnp.zeros((rounds, bits.size), dtype)
    start = (jnp.int32(0), bits, buffer.inverse, drawn)
    turns, rest, nearest, drawn = jax.lax.while_loop(going, approach, start)
    triangle = jnp.where(nearest > buffer.inverse, NONE, buffer.triangle)
    return Buffer(nearest, jax.lax.fori_loop(0, turns, claim, triangle)), rest
