"""Seeded noise in space: an integer hash and gradient noise of a wavelength in millimetres.

Noise is a function of a point of space and a seed, with no state and no table. A texture that
evaluates it at the points its texels show has no seams, and looks the same at any resolution.
Vectors are (3, n): one long row a component.
"""

import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Float, Int

_PRIMES = np.array([0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D], np.uint32)
# A turn about a skew axis, so that no octave's lattice lies along the head's own axes.
_TURN = np.array(
    [[0.6627, -0.3721, 0.6499], [0.6931, 0.6281, -0.3471], [-0.2790, 0.6804, 0.6761]], np.float32
)


def mix(value: Int[Array, "*n"]) -> Int[Array, "*n"]:
    """Scramble 32 bits so that near inputs give unlike outputs (Wellons' "lowbias32")."""
    value = (value ^ (value >> 16)) * jnp.uint32(0x7FEB352D)
    value = (value ^ (value >> 15)) * jnp.uint32(0x846CA68B)
    return value ^ (value >> 16)


def cell_hash(cell: Int[Array, "3 n"], seed: Int[Array, ""]) -> Int[Array, "n"]:
    """32 random bits for each cell of a lattice."""
    x, y, z = (cell[axis].astype(jnp.uint32) * _PRIMES[axis] for axis in range(3))
    return mix(x ^ y ^ z ^ seed)


def layer_seed(seed: Int[Array, ""], layer: int) -> Int[Array, ""]:
    """A seed of its own for each layer of a subject."""
    return mix(seed ^ jnp.uint32((layer * 0x27D4EB2F + 0x165667B1) & 0xFFFFFFFF))


def uniforms(bits: Int[Array, "*n"]) -> tuple[Array, Array, Array]:
    """Three numbers in [0, 1) from 32 bits, ten bits each."""
    scale = 1.0 / 1024
    return tuple(((bits >> shift) & 1023).astype(jnp.float32) * scale for shift in (2, 12, 22))


def gradient_noise(
    position: Float[Array, "3 n"], wavelength: float | Array, seed: Int[Array, ""]
) -> Float[Array, "n"]:
    """Smooth noise with mean 0 and a standard deviation of about 1, of one wavelength.

    Perlin, "Improving noise", SIGGRAPH 2002: random gradients at the corners of a lattice, blended
    by a quintic. The lattice is turned, and its spacing is half the wavelength.

    Args:
        position: mm.
        wavelength: mm; power is spread over about an octave around it.
        seed: of this noise.
    """
    point = jnp.einsum("ij,jn->in", jnp.asarray(_TURN), position) * (2.0 / wavelength)
    low = jnp.floor(point)
    part = point - low
    cell = low.astype(jnp.int32)
    fade = part * part * part * (part * (part * 6.0 - 15.0) + 10.0)
    hashed = [cell[axis].astype(jnp.uint32) * _PRIMES[axis] for axis in range(3)]
    nearer = [[1.0 - fade[axis], fade[axis]] for axis in range(3)]
    total = jnp.zeros_like(part[0])
    for i in (0, 1):
        for j in (0, 1):
            for k in (0, 1):
                bits = mix(
                    (hashed[0] + jnp.uint32(i) * _PRIMES[0])
                    ^ (hashed[1] + jnp.uint32(j) * _PRIMES[1])
                    ^ (hashed[2] + jnp.uint32(k) * _PRIMES[2])
                    ^ seed
                )
                a, b, c = uniforms(bits)
                slope = (
                    (a - 0.5) * (part[0] - i)
                    + (b - 0.5) * (part[1] - j)
                    + (c - 0.5) * (part[2] - k)
                )
                total = total + slope * (nearer[0][i] * nearer[1][j] * nearer[2][k])
    return total * 5.6


def visible(wavelength: float | Array, texel: Float[Array, "n"]) -> Float[Array, "n"]:
    """How much of a wave of that length a texture shows: 0 below 2 texels, 1 above 4."""
    share = jnp.clip(wavelength / (2.0 * texel) - 1.0, 0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)


def spectrum_noise(
    position: Float[Array, "3 n"],
    wavelengths: tuple[float, ...],
    amplitudes: tuple[float, ...],
    texel: Float[Array, "n"],
    seed: Int[Array, ""],
) -> Float[Array, "n"]:
    """A sum of `gradient_noise` with a standard deviation for each wavelength (mm).

    Args:
        position: mm.
        wavelengths: mm.
        amplitudes: standard deviation of each.
        texel: size of a texel (mm); waves too short for it are left out.
        seed: of this noise.
    """
    total = jnp.zeros_like(position[0])
    for index, (wavelength, amplitude) in enumerate(zip(wavelengths, amplitudes, strict=True)):
        wave = gradient_noise(position, wavelength, layer_seed(seed, index))
        total = total + amplitude * visible(wavelength, texel) * wave
    return total
