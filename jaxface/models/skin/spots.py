"""Points scattered over a surface: what pores, hairs, freckles and moles have in common.

Every cell of a lattice in space owns one random point. The points near a surface are seen from
it along its normal, so a spot is as large as it says wherever the surface cuts the lattice.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxface._types import Array, Int
from jaxface.models.skin.noise import cell_hash, lattice, mix, uniforms
from jaxface.models.skin.rows import Row, Vector, dot


class Spot(NamedTuple):
    """One candidate point as each texel sees it."""

    offset: Vector
    """from the point to the texel, along the surface (mm)"""
    on_surface: Row
    """1 for a point on the surface, falling to 0 at half a cell above or below it"""
    random: Vector
    """three uniform numbers of the point's own"""

    @property
    def distance2(self) -> Row:
        """Squared distance along the surface (mm^2)."""
        return dot(self.offset, self.offset)


def gather_spots(
    position: Vector,
    normal: Vector,
    cell: float,
    seed: Int[Array, ""],
    shade: Callable[[Spot], Row],
) -> Row:
    """Largest ``shade`` over the points near each texel.

    There is about one point per ``cell^2`` of surface. Each texel looks into the eight cells
    around it, so a spot must end within half a cell of its point.

    Args:
        position: texels' points (mm).
        normal: unit normals there.
        cell: spacing (mm).
        seed: of this layer.
        shade: value (0 or more) that a point gives to the texels.
    """
    scaled = [p * (1.0 / cell) for p in position]
    corner = [jnp.floor(s - 0.5) for s in scaled]
    part = [s - c for s, c in zip(scaled, corner, strict=True)]
    base = lattice((corner[0], corner[1], corner[2]))

    def add(index: Array, total: Row) -> Row:
        step = (index & 1, (index >> 1) & 1, index >> 2)
        bits = cell_hash(base, step, seed)
        place = uniforms(bits)
        x, y, z = ((t - s - q) * cell for t, s, q in zip(part, step, place, strict=True))
        height = dot((x, y, z), normal)
        x, y, z = (d - height * n for d, n in zip((x, y, z), normal, strict=True))
        lift = jnp.maximum(1.0 - jnp.square(height * (2.0 / cell)), 0.0)
        spot = Spot((x, y, z), lift, uniforms(mix(bits + jnp.uint32(0x68BC21EB))))
        return jnp.maximum(total, shade(spot))

    # A loop: one cell is compiled, and XLA cannot fuse all of them into every consumer.
    return jax.lax.fori_loop(0, 8, add, jnp.zeros_like(part[0]))


def soft_disc(distance2: Row, radius: Row | float, texel: Row) -> Row:
    """A dot with a soft rim, 1 in the middle, as a texture of that texel size shows it.

    The dot is widened by half a texel and weakened so that it keeps its volume.

    Args:
        distance2: squared distance from the middle (mm^2).
        radius: where it has fallen to 0 (mm).
        texel: mm.
    """
    wide2 = radius * radius + 0.5 * texel * texel
    fall = jnp.maximum(1.0 - distance2 / wide2, 0.0)
    return fall * fall * (radius * radius / wide2)


def stroke(
    offset: Vector, along: Vector, across: Vector, lean: Row, length: Row, width: float, texel: Row
) -> Row:
    """A short soft line through the point, as a texture of that texel size shows it.

    Args:
        offset: from its middle to the texel, along the surface (mm).
        along: unit direction of hair at the texel.
        across: unit direction at a right angle to it.
        lean: tangent of the angle by which the line is turned from ``along`` to ``across``.
        length: half of it (mm).
        width: half of it (mm).
        texel: mm.
    """
    straight = jax.lax.rsqrt(1.0 + lean * lean)
    u, v = dot(offset, along), dot(offset, across)
    u, v = (u + lean * v) * straight, (v - lean * u) * straight
    wide2 = width * width + 0.35 * texel * texel
    long2 = length * length + 0.35 * texel * texel
    fall = jnp.maximum(1.0 - v * v / wide2 - u * u / long2, 0.0)
    return fall * (width * length) * jax.lax.rsqrt(wide2 * long2)


def likely(chance: Row, random: Row, sharp: float = 12.0) -> Row:
    """Near 1 where a point of this random number is present at that chance, else near 0."""
    return jnp.clip((chance - random) * sharp + 0.5, 0.0, 1.0)
