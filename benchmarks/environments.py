"""Distant lights for the ground-truth renders, as latitude-longitude radiance maps.

Directions live in the camera's frame (x right, y up, z towards the viewer). A light is an
ambient colour plus a few cosine lobes ``colour * max(d . axis, 0)^sharpness``, which keeps its
description to a few numbers, or a captured panorama read from an EXR file. What a fit can be held
to is the irradiance ``E(n) = integral L(w) max(n . w, 0) dw``; here it is integrated numerically
from the map itself, without spherical harmonics.
"""

from dataclasses import dataclass

import numpy as np

MAP_HEIGHT = 64
LIGHTS = ("soft", "side", "coloured")


@dataclass(frozen=True)
class Lobe:
    """One soft source: ``colour * max(d . axis, 0)^sharpness``."""

    axis: np.ndarray
    colour: np.ndarray
    sharpness: float


@dataclass(frozen=True)
class Light:
    """An ambient colour and lobes (radiance, arbitrary unit, linear RGB)."""

    ambient: np.ndarray
    lobes: tuple[Lobe, ...]

    def table(self) -> np.ndarray:
        """One row of 7 per lobe: axis, colour, sharpness; row 0 is the ambient colour."""
        rows = [np.concatenate([np.zeros(3), self.ambient, [0.0]])]
        rows += [np.concatenate([lobe.axis, lobe.colour, [lobe.sharpness]]) for lobe in self.lobes]
        return np.stack(rows).astype(np.float32)


def from_table(table: np.ndarray) -> Light:
    """The inverse of :meth:`Light.table`."""
    lobes = tuple(Lobe(row[:3], row[3:6], float(row[6])) for row in table[1:])
    return Light(table[0, 3:6], lobes)


def _direction(azimuth: float, elevation: float) -> np.ndarray:
    """Unit vector; azimuth 0 is towards the viewer and grows to the right (degrees)."""
    a, e = np.deg2rad([azimuth, elevation])
    return np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])


def draw_light(kind: str, rng: np.random.Generator) -> Light:
    """A random light of one kind.

    ``soft``: a large source from the front and above over much ambient light. ``side``: a
    smaller source far to one side, little else. ``coloured``: a warm key against a cool fill.

    Raises:
        ValueError: ``kind`` is not one of ``LIGHTS``.
    """
    sign = rng.choice([-1.0, 1.0])
    tint = 1.0 + rng.uniform(-0.06, 0.06, 3)
    if kind == "soft":
        axis = _direction(sign * rng.uniform(10, 40), rng.uniform(20, 50))
        return Light(0.30 * tint, (Lobe(axis, 1.0 * tint[::-1], 4.0),))
    if kind == "side":
        axis = _direction(sign * rng.uniform(55, 75), rng.uniform(10, 30))
        return Light(0.12 * tint, (Lobe(axis, 4.0 * tint[::-1], 30.0),))
    if kind == "coloured":
        key = _direction(sign * rng.uniform(25, 50), rng.uniform(15, 40))
        fill = _direction(-sign * rng.uniform(50, 80), rng.uniform(-10, 20))
        warm, cool = np.array([1.0, 0.78, 0.55]), np.array([0.45, 0.6, 0.9])
        return Light(0.12 * tint, (Lobe(key, 1.6 * warm, 8.0), Lobe(fill, 0.9 * cool, 4.0)))
    raise ValueError(f"kind {kind!r} is not a light; choose one of {LIGHTS}")


def map_directions(height: int = MAP_HEIGHT) -> np.ndarray:
    """Unit directions (H, 2H, 3) of a map's pixel centres, row 0 up.

    Column 0 starts at -z (behind the face, as the viewer looks along -z) and columns go round
    through +x, which is how mitsuba's ``envmap`` reads a bitmap.
    """
    theta = (np.arange(height) + 0.5) / height * np.pi
    phi = (np.arange(2 * height) + 0.5) / (2 * height) * 2 * np.pi
    theta, phi = np.meshgrid(theta, phi, indexing="ij")
    sine = np.sin(theta)
    return np.stack([np.sin(phi) * sine, np.cos(theta), -np.cos(phi) * sine], axis=-1)


def radiance_map(light: Light, height: int = MAP_HEIGHT) -> np.ndarray:
    """Radiance (H, 2H, 3) of a light, linear RGB."""
    directions = map_directions(height)
    radiance = np.broadcast_to(light.ambient, directions.shape).astype(float)
    for lobe in light.lobes:
        cosine = np.maximum(directions @ lobe.axis, 0.0)
        radiance = radiance + cosine[..., None] ** lobe.sharpness * lobe.colour
    return radiance.astype(np.float32)


def irradiance(radiance: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Irradiance (n, 3) that a map (H, 2H, 3) sheds on unit normals (n, 3), nothing in its way."""
    height = radiance.shape[0]
    directions = map_directions(height).reshape(-1, 3)
    theta = (np.arange(height) + 0.5) / height * np.pi
    solid = np.repeat(np.sin(theta), 2 * height) * (np.pi / height) ** 2
    weighted = radiance.reshape(-1, 3) * solid[:, None]
    result = [
        np.maximum(chunk @ directions.T, 0.0) @ weighted
        for chunk in np.array_split(normals, max(1, len(normals) // 2000))
    ]
    return np.concatenate(result)
