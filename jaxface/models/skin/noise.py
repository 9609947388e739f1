"""Seeded noise in space: an integer hash and gradient noise of a wavelength in millimetres.

Noise is a function of a point of space and a seed, with no state and no table. A texture that
evaluates it at the points its texels show has no seams, and looks the same at any resolution.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Int
from jaxface.models.skin.rows import Row, Vector

Bits = Int[Array, "n"]

_PRIMES = np.array([0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D], np.uint32)
# A turn about a skew axis, so that the lattice does not lie along the head's own axes.
_TURN = ((0.6627, -0.3721, 0.6499), (0.6931, 0.6281, -0.3471), (-0.2790, 0.6804, 0.6761))
_TO_UNIT_STD = 5.35


def mix(value: Bits) -> Bits:
    """Scramble 32 bits so that near inputs give unlike outputs (Wellons' "lowbias32")."""
    value = (value ^ (value >> 16)) * jnp.uint32(0x7FEB352D)
    value = (value ^ (value >> 15)) * jnp.uint32(0x846CA68B)
    return value ^ (value >> 16)


def layer_seed(seed: Int[Array, ""], layer: Int[Array, ""] | int) -> Int[Array, ""]:
    """A seed of its own for each layer of a subject."""
    number = jnp.asarray(layer, jnp.int32).astype(jnp.uint32)
    return mix(seed ^ (number * jnp.uint32(0x27D4EB2F) + jnp.uint32(0x165667B1)))


def lattice(corner: Vector) -> tuple[Bits, Bits, Bits]:
    """Integer coordinates of a cell, premultiplied for `cell_hash`."""
    return tuple(
        c.astype(jnp.int32).astype(jnp.uint32) * prime
        for c, prime in zip(corner, _PRIMES, strict=True)
    )


def cell_hash(
    cell: tuple[Bits, Bits, Bits], step: tuple[Array | int, ...], seed: Int[Array, ""]
) -> Bits:
    """32 random bits for the cell ``step`` cells away from one of `lattice`."""
    x, y, z = (
        c + jnp.asarray(s, jnp.int32).astype(jnp.uint32) * prime
        for c, s, prime in zip(cell, step, _PRIMES, strict=True)
    )
    return mix(x ^ y ^ z ^ seed)


def uniforms(bits: Bits) -> Vector:
    """Three numbers in [0, 1) from 32 bits, ten bits each."""
    a, b, c = (((bits >> shift) & 1023).astype(jnp.float32) * (1 / 1024) for shift in (2, 12, 22))
    return a, b, c


def gradient_noise(position: Vector, wavelength: float | Array, seed: Int[Array, ""]) -> Row:
    """Smooth noise with mean 0 and a standard deviation of about 1, of one wavelength.

    Perlin, "Improving noise", SIGGRAPH 2002: random gradients at the corners of a lattice, blended
    by a quintic. Its spectrum is about an octave wide and peaks near a wavelength of 1.6 lattice
    spacings.

    Args:
        position: mm.
        wavelength: mm.
        seed: of this noise.
    """
    scale = 1.6 / wavelength
    point = [sum(p * (t * scale) for p, t in zip(position, row, strict=True)) for row in _TURN]
    low = [jnp.floor(p) for p in point]
    part = [p - f for p, f in zip(point, low, strict=True)]
    cell = lattice((low[0], low[1], low[2]))
    fade = [t * t * t * (t * (t * 6.0 - 15.0) + 10.0) for t in part]

    def add(index: Array, total: Row) -> Row:
        step = (index & 1, (index >> 1) & 1, index >> 2)
        slopes = uniforms(cell_hash(cell, step, seed))
        slope = sum((g - 0.5) * (t - s) for g, t, s in zip(slopes, part, step, strict=True))
        weights = [jnp.where(s == 1, f, 1 - f) for s, f in zip(step, fade, strict=True)]
        return total + slope * weights[0] * weights[1] * weights[2]

    # A loop: one corner is compiled, and XLA cannot fuse all of them into every consumer.
    total = jax.lax.fori_loop(0, 8, add, jnp.zeros_like(part[0]))
    return total * (2 * _TO_UNIT_STD)


def visible(wavelength: float | Array, texel: Row) -> Row:
    """How much of a wave of that length a texture shows: 0 below 2 texels, 1 above 4."""
    share = jnp.clip(wavelength / (2.0 * texel) - 1.0, 0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)


def spectrum_noise(
    position: Vector,
    wavelengths: tuple[float, ...],
    amplitudes: tuple[float, ...],
    texel: Row,
    seed: Int[Array, ""],
) -> Row:
    """A sum of `gradient_noise` with a standard deviation for each wavelength (mm).

    Args:
        position: mm.
        wavelengths: mm.
        amplitudes: standard deviation of each.
        texel: size of a texel (mm); waves too short for it are left out.
        seed: of this noise.
    """
    waves, strengths = jnp.array(wavelengths), jnp.array(amplitudes)

    def add(index: Array, total: Row) -> Row:
        wave = gradient_noise(position, waves[index], layer_seed(seed, index))
        return total + strengths[index] * visible(waves[index], texel) * wave

    # A loop, not a sum: one octave is compiled, and XLA cannot fuse it into every consumer.
    return jax.lax.fori_loop(0, len(wavelengths), add, jnp.zeros_like(position[0]))
