"""A made-up head that the tests of model formats share, and the formulas they compare with."""

import numpy as np


def head(count=12):
    """A ball of triangles (mm), seen from outside counter-clockwise, nose towards +z."""
    v, u = np.mgrid[0 : count // 2 + 1, 0:count].reshape(2, -1)
    latitude, longitude = np.pi * (v + 0.5) / (count / 2 + 1), 2 * np.pi * u / count
    vertices = 80 * np.stack(
        [
            np.sin(latitude) * np.sin(longitude),
            -1.2 * np.cos(latitude),
            np.sin(latitude) * np.cos(longitude),
        ],
        axis=1,
    )
    i, j = np.mgrid[0 : count // 2, 0:count].reshape(2, -1)
    a, b = i * count + j, i * count + (j + 1) % count
    faces = np.concatenate([np.stack([a, b, b + count], 1), np.stack([a, b + count, a + count], 1)])
    return vertices, faces


VERTICES, FACES = head()
COUNT = len(VERTICES)


def orthonormal(modes, seed):
    values = np.random.default_rng(seed).normal(size=(3 * COUNT, modes))
    return np.linalg.qr(values)[0].astype(np.float32)


def decode(srgb):
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def outward_volume(model):
    """Signed volume (mm^3): positive for triangles counter-clockwise from outside."""
    a, b, c = np.moveaxis(np.asarray(model.mean)[np.asarray(model.faces)], 1, 0)
    return np.einsum("fi,fi->", a, np.cross(b, c)) / 6
