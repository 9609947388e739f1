"""The network of fine furrows that divides skin into cells of half a millimetre."""

import jax
import jax.numpy as jnp

from jaxface._types import Array, Int
from jaxface.models.skin.attributes import SkinAttributes
from jaxface.models.skin.noise import cell_hash, lattice, layer_seed, uniforms, visible
from jaxface.models.skin.patch import SkinPatch
from jaxface.models.skin.pigments import Density
from jaxface.models.skin.rows import Row, dot

CELLS = (1.35, 0.8)
"""size of the cells (mm) of the coarse and of the fine network"""
STRENGTHS = (0.08, 0.025)
STRETCH = 0.5
"""share by which squared distances along the lines of tension count less"""
EDGE = 0.36
"""half the width of a furrow, in cells"""


def furrows(patch: SkinPatch, traits: SkinAttributes, seed: Int[Array, ""]) -> Density:
    """Density of the furrows and of the paler cells between them, with mean about zero.

    Edges of a Voronoi diagram (Worley, "A cellular texture basis function", SIGGRAPH 1996) whose
    metric follows the lines of tension. Each cell has a tone of its own.
    """
    r = patch.regions
    amount = r.skin * (1 - 0.6 * r.nose) * (1 - r.lips) * (0.8 + 0.1 * r.forehead + 0.5 * r.lid)
    depth = jnp.zeros_like(r.skin)
    for layer, (cell, strength) in enumerate(zip(CELLS, STRENGTHS, strict=True)):
        near, next_near, tone = _two_nearest(patch, cell, layer_seed(seed, 20 + layer))
        edge = jnp.clip(1.0 - (next_near - near) / EDGE, 0.0, 1.0)
        shown = visible(cell * 1.3, patch.texel)
        depth = depth + strength * shown * (edge * edge - 0.17 + 0.35 * (tone - 0.5))
    depth = depth * amount * traits.furrows
    return Density(0.3 * depth, 0.45 * depth, 0.25 * depth)


def _two_nearest(patch: SkinPatch, cell: float, seed: Int[Array, ""]) -> tuple[Row, Row, Row]:
    """Distances (cells) to the nearest two of one random point per cell, and the first's number."""
    scaled = [p * (1.0 / cell) for p in patch.position]
    corner = [jnp.floor(s) for s in scaled]
    part = [s - c for s, c in zip(scaled, corner, strict=True)]
    base = lattice((corner[0], corner[1], corner[2]))

    def add(index: Array, found: tuple[Row, Row, Row]) -> tuple[Row, Row, Row]:
        first, second, tone = found
        step = (index % 3 - 1, index // 3 % 3 - 1, index // 9 - 1)
        place = uniforms(cell_hash(base, step, seed))
        x, y, z = (t - s - q for t, s, q in zip(part, step, place, strict=True))
        along = dot((x, y, z), patch.tension)
        squared = x * x + y * y + z * z - STRETCH * along * along
        second = jnp.minimum(second, jnp.maximum(first, squared))
        tone = jnp.where(squared < first, place[0], tone)
        return jnp.minimum(first, squared), second, tone

    far = jnp.full_like(part[0], 9.0)
    first, second, tone = jax.lax.fori_loop(0, 27, add, (far, far, jnp.zeros_like(far)))
    return jnp.sqrt(jnp.maximum(first, 0.0)), jnp.sqrt(jnp.maximum(second, 0.0)), tone
