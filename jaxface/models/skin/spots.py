"""Points scattered over a surface: what pores, hairs, freckles and moles have in common.

Every cell of a lattice in space owns one random point. The points near a surface are seen from
it along its normal, so a spot is as large as it says wherever the surface cuts the lattice.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp

from jaxface._types import Array, Float, Int
from jaxface.models.skin.noise import cell_hash, mix, uniforms


class Spot(NamedTuple):
    """One candidate point as each texel sees it."""

    offset: tuple[Array, Array, Array]
    """from the point to the texel, along the surface (mm)"""
    distance2: Float[Array, "n"]
    """squared length of the offset (mm^2)"""
    on_surface: Float[Array, "n"]
    """1 for a point on the surface, falling to 0 at half a cell above or below it"""
    random: tuple[Array, Array, Array]
    """three uniform numbers of the point's own"""


def gather_spots(
    position: Float[Array, "3 n"],
    normal: Float[Array, "3 n"],
    cell: float,
    seed: Int[Array, ""],
    shade: Callable[[Spot], Float[Array, "n"]],
) -> Float[Array, "n"]:
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
    scaled = position * (1.0 / cell)
    corner = jnp.floor(scaled - 0.5)
    part = scaled - corner
    base = corner.astype(jnp.int32)
    total = jnp.zeros_like(part[0])
    for i in (0, 1):
        for j in (0, 1):
            for k in (0, 1):
                step = (i, j, k)
                bits = cell_hash(
                    [base[axis] + step[axis] for axis in range(3)],
                    seed,  # type: ignore[arg-type]
                )
                place = uniforms(bits)
                delta = [(part[axis] - step[axis] - place[axis]) * cell for axis in range(3)]
                height = sum(delta[axis] * normal[axis] for axis in range(3))
                x, y, z = (delta[axis] - height * normal[axis] for axis in range(3))
                lift = 1.0 - jnp.square(height * (2.0 / cell))
                spot = Spot(
                    (x, y, z),
                    x * x + y * y + z * z,
                    jnp.maximum(lift, 0.0),
                    uniforms(mix(bits + jnp.uint32(0x68BC21EB))),
                )
                total = jnp.maximum(total, shade(spot))
    return total


def soft_disc(
    distance2: Float[Array, "n"], radius: Array | float, texel: Float[Array, "n"]
) -> Float[Array, "n"]:
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
