"""The network of fine furrows that divides skin into cells of half a millimetre."""

import jax.numpy as jnp

from jaxface._types import Array, Float, Int
from jaxface.models.skin.attributes import SkinAttributes
from jaxface.models.skin.noise import cell_hash, layer_seed, uniforms, visible
from jaxface.models.skin.patch import SkinPatch

# Size of the cells (mm) of the coarse and of the fine network.
CELLS = (1.05, 0.55)
STRENGTHS = (0.075, 0.06)
STRETCH = 0.45
"""share by which cells are longer along the lines of tension"""


def furrows(patch: SkinPatch, traits: SkinAttributes, seed: Int[Array, ""]) -> Float[Array, "3 n"]:
    """Density of the furrows (rows of `pigments.PIGMENTS`), with mean about zero.

    Edges of a Voronoi diagram (Worley, "A cellular texture basis function", SIGGRAPH 1996) whose
    metric follows the lines of tension.
    """
    r = patch.regions
    amount = r.skin * (1 - 0.6 * r.nose) * (1 - r.lips) * (0.75 + 0.35 * r.forehead + 0.5 * r.lid)
    depth = jnp.zeros_like(r.skin)
    for layer, (cell, strength) in enumerate(zip(CELLS, STRENGTHS, strict=True)):
        near, next_near = _two_nearest(patch, cell, layer_seed(seed, 20 + layer))
        edge = jnp.clip(1.0 - (next_near - near) / 0.32, 0.0, 1.0)
        shown = visible(cell * 1.2, patch.texel)
        depth = depth + strength * shown * (edge * edge - 0.15)
    depth = depth * amount * traits.furrows
    return jnp.stack([0.3 * depth, 0.35 * depth, 0.35 * depth])


def _two_nearest(
    patch: SkinPatch, cell: float, seed: Int[Array, ""]
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """Distance to the nearest and the second nearest of one random point per cell (cells)."""
    scaled = patch.position * (1.0 / cell)
    corner = jnp.floor(scaled)
    part = scaled - corner
    base = corner.astype(jnp.int32)
    first = jnp.full_like(part[0], 9.0)
    second = first
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            for k in (-1, 0, 1):
                step = (i, j, k)
                place = uniforms(cell_hash([base[a] + step[a] for a in range(3)], seed))
                delta = [part[a] - step[a] - place[a] for a in range(3)]
                along = sum(d * t for d, t in zip(delta, patch.tension, strict=True))
                squared = sum(d * d for d in delta) - STRETCH * along * along
                second = jnp.minimum(second, jnp.maximum(first, squared))
                first = jnp.minimum(first, squared)
    return jnp.sqrt(jnp.maximum(first, 0.0)), jnp.sqrt(jnp.maximum(second, 0.0))
