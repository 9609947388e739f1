"""Hair as short strokes: beard stubble, brows, the roots on the scalp, pale down on the cheeks."""

import jax
import jax.numpy as jnp

from jaxface._types import Array, Int
from jaxface.imaging.masks import smoothstep
from jaxface.models.skin.attributes import SkinAttributes
from jaxface.models.skin.noise import gradient_noise, layer_seed, mix, spectrum_noise, uniforms
from jaxface.models.skin.patch import SkinPatch
from jaxface.models.skin.pigments import Density
from jaxface.models.skin.rows import Row, Vector, cross
from jaxface.models.skin.spots import Spot, gather_spots, likely, stroke

STUBBLE_CELL, SCALP_CELL, BROW_CELL, DOWN_CELL = 1.0, 1.1, 5.0, 1.3
"""mm; a stroke is at most as long"""
HALF_WIDTH = 0.09
"""mm, of a thick hair"""
STUBBLE_WIDTH = 0.16
"""mm, half the width at which a short hair and its root show: light spreads under the skin"""
CLUMPS, CLUMPING = (2.5, 5.0, 10.0, 20.0), (0.2, 0.2, 0.22, 0.28)
"""wavelengths (mm) at which a beard is denser or thinner, and how much (of its logarithm)"""


def _strokes(
    patch: SkinPatch,
    direction: Vector,
    cell: float,
    chance: Row,
    lean: Row,
    spread: float,
    length: tuple[float | Array, float | Array],
    width: float,
    seed: Int[Array, ""],
    layers: int = 1,
) -> Row:
    """Cover of hairs, ``layers`` of them per ``cell^2`` mm^2 where the chance is 1.

    Args:
        patch: texels.
        direction: of growth.
        cell: mm.
        chance: that a hair is present.
        lean: tangent of the angle to the direction, common to all.
        spread: range of the tangents of single hairs.
        length: half of the shortest and of the longest (mm); at most half a cell.
        width: half of it (mm).
        seed: of this kind of hair.
        layers: independent sets of hairs laid over each other.
    """
    chance, lean = jax.lax.optimization_barrier((chance, lean))
    across = jax.lax.optimization_barrier(cross(patch.normal, direction))

    def shade(spot: Spot) -> Row:
        u, v, w = spot.random
        half = length[0] + (length[1] - length[0]) * v
        line = stroke(
            spot.offset, direction, across, lean + (w - 0.5) * spread, half, width, patch.texel
        )
        near = jnp.minimum(3.0 * spot.on_surface, 1.0)
        return likely(chance, u, 10.0) * near * line * (0.45 + 0.55 * v)

    def add(layer: Array, cover: Row) -> Row:
        seed_of = mix(seed + jnp.uint32(0x9E3779B9) * (layer.astype(jnp.uint32) + 1))
        return cover + gather_spots(patch.position, patch.normal, cell, seed_of, shade)

    return jax.lax.fori_loop(0, layers, add, jnp.zeros_like(chance))


def stubble(patch: SkinPatch, traits: SkinAttributes, seed: Int[Array, ""]) -> Density:
    """Density of the beard: strokes, and the blue-grey of the roots under the skin."""
    clumps = spectrum_noise(patch.position, CLUMPS, CLUMPING, patch.texel, layer_seed(seed, 50))
    thick = jnp.clip(jnp.exp(clumps), 0.3, 2.2)
    lean = 0.23 * gradient_noise(patch.position, 12.0, layer_seed(seed, 51))
    where = jnp.clip(patch.regions.beard * 1.3 - 0.1, 0.0, 1.0)
    grown = 0.25 + 0.75 * traits.stubble
    chance = where * (0.35 + 0.65 * traits.stubble) * jnp.sqrt(jnp.sqrt(thick))
    hairs = _strokes(
        patch, patch.hair, STUBBLE_CELL, chance, lean, 1.0,
        (0.12, 0.12 + 0.36 * grown), STUBBLE_WIDTH, layer_seed(seed, 52), layers=4,
    )  # fmt: skip
    dark = (0.3 + 0.7 * traits.hair_melanin) * where**0.5
    hairs = 0.85 * (0.35 + 0.65 * traits.stubble) * dark * jnp.sqrt(thick) * hairs
    shadow = 0.4 * traits.stubble * dark * where * thick
    # Roots seen through the skin look blue: melanin's share is negative to take away yellow.
    return Density(0.25 * hairs - 0.5 * shadow, -0.15 * shadow, 0.75 * hairs + 1.4 * shadow)


def brows(patch: SkinPatch, traits: SkinAttributes, seed: Int[Array, ""]) -> Density:
    """Density of single hairs over the soft brows of the base albedo."""
    x, side = patch.position[0], jnp.sign(patch.position[0])
    # Hairs stand up at the inner end and lie outwards along the brow.
    outer = jnp.clip(jnp.abs(x) / 45.0, 0.0, 1.0)
    up = 1.1 - 1.25 * outer
    direction = (side * (0.35 + outer), up, jnp.zeros_like(x))
    height = sum(d * n for d, n in zip(direction, patch.normal, strict=True))
    flat = tuple(d - height * n for d, n in zip(direction, patch.normal, strict=True))
    inverse = 1.0 / jnp.sqrt(sum(d * d for d in flat) + 1e-6)
    direction = jax.lax.optimization_barrier(tuple(d * inverse for d in flat))
    # Subjects differ in how wide their brows are, and each brow is thicker in places.
    wide, full, _ = uniforms(layer_seed(seed, 61))
    thick = 1.1 + 1.1 * wide + 0.5 * traits.male + 0.2 * gradient_noise(
        patch.position, 9.0, layer_seed(seed, 62)
    )  # fmt: skip
    where = smoothstep(thick * patch.regions.brow, 0.12, 0.9)
    hairs = _strokes(
        patch, direction, BROW_CELL, where * (0.55 + 0.45 * full), jnp.zeros_like(x), 0.9,
        (1.2, 2.4), 0.12, layer_seed(seed, 60), layers=16,
    )  # fmt: skip
    amount = (0.4 + 0.6 * traits.hair_melanin) * (0.7 + 0.3 * traits.male)
    roots = 0.45 * where * full
    return Density(amount * (0.3 * hairs + 0.3 * roots), 0.0, amount * (0.8 * hairs + 0.5 * roots))


def scalp_roots(patch: SkinPatch, traits: SkinAttributes, seed: Int[Array, ""]) -> Density:
    """Density of shorn hair on the scalp."""
    patchy = gradient_noise(patch.position, 9.0, layer_seed(seed, 80))
    # The scalp's weight falls off over the forehead, where hair is thin and then absent.
    where = smoothstep(patch.regions.scalp + 0.05 * patchy, 0.35, 0.95)
    lean = 0.4 * gradient_noise(patch.position, 25.0, layer_seed(seed, 81))
    hairs = _strokes(
        patch, patch.hair, SCALP_CELL, where, lean, 0.8, (0.2, 0.5), HALF_WIDTH,
        layer_seed(seed, 82), layers=2,
    )  # fmt: skip
    hairs = hairs * (0.35 + 0.65 * traits.hair_melanin)
    return Density(0.25 * hairs, 0.0, 0.6 * hairs)


def down(patch: SkinPatch, traits: SkinAttributes, seed: Int[Array, ""]) -> Density:
    """Density (negative: paler) of the fine down of cheeks, temples and forehead."""
    r = patch.regions
    where = r.skin * (1 - r.lips) * (1 - 0.7 * r.nose) * (1 - r.scalp)
    lean = 0.45 * gradient_noise(patch.position, 20.0, layer_seed(seed, 90))
    hairs = _strokes(
        patch, patch.hair, DOWN_CELL, where, lean, 0.7, (0.3, 0.65), 0.17, layer_seed(seed, 91)
    )
    pale = 0.032 * traits.furrows * hairs
    return Density(-0.5 * pale, -0.5 * pale)
