"""Wrinkles: lines of the forehead, between the brows, around eyes and mouth, and of the neck.

Lines are curves of the frontal plane placed by the landmarks, bent and broken by noise. Albedo
shows them as thin darker, redder lines in a broad faint valley.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Int
from jaxface.imaging.masks import smoothstep
from jaxface.models.skin.attributes import SkinAttributes
from jaxface.models.skin.noise import gradient_noise, layer_seed
from jaxface.models.skin.patch import SkinPatch
from jaxface.models.skin.pigments import Density
from jaxface.models.skin.rows import Row

_FOREHEAD = np.array([0.6, 1.0, 0.85, 0.5], np.float32)
_RAYS = np.radians(np.array([-38.0, -17.0, 3.0, 24.0, 44.0], np.float32))
_UNDER_EYE = np.array([[1.0, 0.5], [1.25, 0.35], [1.5, 0.3]], np.float32)


class _Bends(NamedTuple):
    """How the lines of a face wander: sideways (mm) and in strength."""

    bend: Row
    broken: Row


def wrinkles(patch: SkinPatch, traits: SkinAttributes, seed: Int[Array, ""]) -> Density:
    """Density of all wrinkles."""
    bend = 0.9 * gradient_noise(patch.position, 26.0, layer_seed(seed, 100))
    bend = bend + 0.14 * gradient_noise(patch.position, 8.0, layer_seed(seed, 101))
    broken = 0.65 + 0.3 * gradient_noise(patch.position, 14.0, layer_seed(seed, 102))
    bends = _Bends(bend, jnp.clip(broken, 0.1, 1.3))
    # Loops, for one line is compiled then, and none is computed once for every pigment.
    lined = jax.lax.fori_loop(
        0, 4, lambda i, sum_: sum_ + _forehead(patch, traits, bends, i), jnp.zeros_like(bend)
    )
    lined = jax.lax.fori_loop(0, 2, lambda i, sum_: sum_ + _side(patch, traits, bends, i), lined)
    lined = jax.lax.fori_loop(0, 3, lambda i, sum_: sum_ + _neck(patch, traits, bends, i), lined)
    r = patch.regions
    lined = lined * r.skin * (1 - r.lips) * smoothstep(patch.position[2], 0.0, 20.0)
    return Density(0.06 * lined, 0.08 * lined, 0.08 * lined)


def _line(patch: SkinPatch, distance: Row, width: float, strength: Row) -> Row:
    """A thin line in a valley four times as wide, ``distance`` mm from its middle."""
    thin = width + 0.5 * patch.texel
    core = _bump(distance / thin) * (width / thin)
    return strength * (0.7 * core + 0.45 * _bump(distance * (0.25 / width)))


def _bump(x: Row) -> Row:
    """Close to ``exp(-x^2)``, and cheaper."""
    return 1.0 / jnp.square(1.0 + 0.5 * x * x)


def _forehead(patch: SkinPatch, traits: SkinAttributes, bends: _Bends, index: Array) -> Row:
    x, y, _ = patch.position
    height = patch.landmarks[17:27, 1].mean() + 9.0 + 8.5 * index
    ends = smoothstep(46.0 - 5.0 * index - jnp.abs(x + 2.0 * bends.bend), 0.0, 22.0)
    strength = jnp.asarray(_FOREHEAD)[index] * traits.wrinkles * bends.broken * ends
    return _line(patch, y - height + 0.0035 * x * x - 1.7 * bends.bend, 0.55, strength)


def _neck(patch: SkinPatch, traits: SkinAttributes, bends: _Bends, index: Array) -> Row:
    x, y, z = patch.position
    throat = patch.regions.neck * smoothstep(z, -10.0, 30.0)
    height = patch.landmarks[8, 1] - 32.0 - 17.0 * index + 0.004 * x * x
    strength = throat * (0.15 + 0.6 * traits.wrinkles) * bends.broken
    return _line(patch, y - height - 2.0 * bends.bend, 0.6, strength)


def _side(patch: SkinPatch, traits: SkinAttributes, bends: _Bends, index: Array) -> Row:
    """The lines of one half of the face: 0 the subject's right, 1 the left."""
    x, y, _ = patch.position
    marks, old = patch.landmarks, traits.wrinkles
    side = 2.0 * index - 1.0
    inner, outer = marks[21 + index], marks[36 + 9 * index]
    wing, corner = marks[31 + 4 * index], marks[48 + 6 * index]
    eye = jax.lax.dynamic_slice_in_dim(marks, 36 + 6 * index, 6).mean(0)
    facing = smoothstep(side * x, 0.0, 4.0)
    # Between the brows.
    window = smoothstep(y, inner[1] - 14, inner[1] - 4) * smoothstep(-y, -inner[1] - 12, -inner[1])
    lined = _line(patch, x - 0.62 * inner[0] - 0.8 * bends.bend, 0.5,
                  0.7 * old * window * bends.broken)  # fmt: skip

    # Crow's feet: rays from a point inside the outer corner of the eye.
    away, up = side * (x - outer[0]) + 7.0, y - outer[1]
    radius = jnp.sqrt(away * away + up * up) + 1e-3
    ring = smoothstep(radius, 10.0, 15.0) * smoothstep(-radius, -36.0, -20.0)
    ring = 0.75 * old * bends.broken * ring / radius

    def ray(i: Array, total: Row) -> Row:
        cosine, sine = jnp.cos(jnp.asarray(_RAYS)[i]), jnp.sin(jnp.asarray(_RAYS)[i])
        near = smoothstep(away * cosine + up * sine, 0.7 * radius, 0.9 * radius)
        distance = up * cosine - away * sine - 0.9 * bends.bend
        return total + _line(patch, distance, 0.45, ring * radius * near)

    lined = jax.lax.fori_loop(0, len(_RAYS), ray, lined)
    oval = jnp.sqrt(jnp.square((x - eye[0]) / 19.0) + jnp.square((y - eye[1]) / 13.0) + 1e-4)
    below = smoothstep(eye[1] - y, 1.0, 6.0) * bends.broken * (0.25 + 0.75 * old)

    def arc(i: Array, total: Row) -> Row:
        level, share = jnp.asarray(_UNDER_EYE)[i, 0], jnp.asarray(_UNDER_EYE)[i, 1]
        return total + _line(patch, 14.0 * (oval - level) - 0.5 * bends.bend, 0.45, share * below)

    lined = jax.lax.fori_loop(0, len(_UNDER_EYE), arc, lined)
    # From the wing of the nose to beside the mouth, and on below its corner.
    fall = (wing[1] - y) / (wing[1] - corner[1])
    curve = wing[0] + side * 4.0 + (corner[0] + side * 3.0 - wing[0]) * fall
    curve = curve + side * 8.0 * jnp.clip(fall * (1.0 - fall), 0.0, 0.25)
    span = smoothstep(fall, -0.15, 0.15) * smoothstep(-fall, -1.35, -0.8)
    fold = _line(patch, 0.75 * (x - curve - 0.7 * bends.bend), 0.7,
                 facing * span * (0.2 + 0.9 * old))  # fmt: skip
    drop = smoothstep(corner[1] - y, 2.0, 7.0) * smoothstep(y - corner[1], -26.0, -14.0)
    course = corner[0] + side * (2.0 - 0.1 * (y - corner[1])) + 0.8 * bends.bend
    return lined + fold + _line(patch, x - course, 0.55, 0.7 * facing * drop * old * old)
