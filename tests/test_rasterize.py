"""The rasteriser against a brute-force float64 loop, and its derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxface.render.rasterize import rasterize

HEIGHT, WIDTH = 45, 61


def brute_force(screen, faces, height, width, cull=False, near=0.0):
    """Ids, weights, depths by a loop over triangles, and where rounding cannot change them.

    A pixel is ``clear`` if no edge function and no difference of depths there lies within a few
    float32 roundings of zero.
    """
    screen, faces = np.asarray(screen, np.float64), np.asarray(faces)
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    ids = np.full((height, width), -1)
    depth = np.full((height, width), np.inf)
    weights = np.zeros((height, width, 3))
    clear = np.ones((height, width), bool)
    rounding = 3e-6
    for t, face in enumerate(faces):
        corner = screen[face]
        if not np.isfinite(corner).all() or (corner[:, 2] <= near).any():
            continue
        e, positive, negative = np.zeros((3, height, width)), True, True
        low, high = np.inf, -np.inf
        for i in range(3):
            a, b = corner[(i + 1) % 3, :2], corner[(i + 2) % 3, :2]
            e[i] = (a[0] - x) * (b[1] - y) - (a[1] - y) * (b[0] - x)
            d = b - a
            top_left = d[1] < 0 or (d[1] == 0 and d[0] > 0)
            bottom_right = d[1] > 0 or (d[1] == 0 and d[0] < 0)
            positive = positive & ((e[i] > 0) | ((e[i] == 0) & top_left))
            negative = negative & ((e[i] < 0) | ((e[i] == 0) & bottom_right))
            reach = np.hypot(a[0] - x, a[1] - y) * np.hypot(b[0] - x, b[1] - y) + 1e-30
            low, high = np.minimum(low, e[i] / reach), np.maximum(high, e[i] / reach)
        inside = negative if cull else positive | negative
        sure = (low > rounding) | (high < -rounding)
        possible = (low > -rounding) | (high < rounding)
        if len(np.unique(corner[:, :2], axis=0)) == 3:
            clear &= sure | ~possible
        if not inside.any():
            continue
        area = e.sum(axis=0)
        area = np.where(inside, area, 1.0)
        inverse = sum(e[i] / corner[i, 2] for i in range(3))
        z = np.where(inside, area / np.where(inside, inverse, 1.0), np.inf)
        both = inside & np.isfinite(depth)
        clear[both] &= np.abs(z[both] - depth[both]) > rounding * z[both]
        closer = inside & (z < depth)
        ids[closer] = t
        depth[closer] = z[closer]
        for i in range(3):
            weights[closer, i] = (e[i] / corner[i, 2] / np.where(inside, inverse, 1.0))[closer]
    return ids, weights, depth, clear


def scene(seed, count=60):
    """Big, tiny, sliver, degenerate, off-screen, straddling and interpenetrating triangles."""
    rng = np.random.default_rng(seed)
    size = np.array([WIDTH, HEIGHT])
    centre = rng.uniform(-0.3, 1.3, (count, 1, 2)) * size
    radius = np.exp(rng.uniform(np.log(0.1), np.log(80.0), (count, 1, 1)))
    xy = centre + radius * rng.normal(size=(count, 3, 2))
    z = rng.uniform(300.0, 900.0, (count, 1)) + radius[:, :, 0] * rng.normal(size=(count, 3))
    corner = np.concatenate([xy, z[..., None]], axis=-1)
    corner[0, 1] = corner[0, 0]  # two corners equal
    corner[1, :] = corner[1, 0]  # a point
    corner[2, 2] = 0.5 * (corner[2, 0] + corner[2, 1])  # three in a line
    corner[3, 0, 2] = -5.0  # behind the camera
    corner[4, 1, 2] = 0.0
    corner[5, :, :2] = [[-1e4, -9e3], [1.3e4, -8e3], [20.0, 2e4]]  # covers the whole image
    corner[5, :, 2] = 1200.0
    corner[6, :, :2] = [[-3e3, 20.0], [3e3, 20.3], [3e3, 20.9]]  # a sliver across it
    corner[7, 0, 0] = np.nan
    corner[8, :, 0] += 3 * WIDTH
    faces = np.arange(3 * count).reshape(count, 3)
    flip = rng.random(count) < 0.5
    faces[flip] = faces[flip][:, ::-1]
    order = rng.permutation(count)
    return corner.reshape(-1, 3), faces[order]


@pytest.mark.parametrize("cull", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_equals_brute_force_in_double_precision(seed, cull):
    screen, faces = scene(seed)
    ids, weights, depth, _ = brute_force(screen, faces, HEIGHT, WIDTH, cull)
    with jax.enable_x64(True):
        got = rasterize(jnp.asarray(screen), jnp.asarray(faces), HEIGHT, WIDTH, cull=cull)
        assert got.depth.dtype == jnp.float64
        np.testing.assert_array_equal(got.triangle, ids)
        np.testing.assert_allclose(got.barycentric, weights, atol=1e-9)
        np.testing.assert_allclose(got.depth, depth, rtol=1e-9)
    assert len(np.unique(ids)) > 5


@pytest.mark.parametrize("seed", range(4, 8))
def test_equals_brute_force_in_single_precision_away_from_ties(seed):
    screen, faces = scene(seed)
    screen = screen.astype(np.float32)
    ids, weights, depth, clear = brute_force(screen, faces, HEIGHT, WIDTH)
    got = rasterize(jnp.asarray(screen), jnp.asarray(faces), HEIGHT, WIDTH)
    assert clear.mean() > 0.97
    np.testing.assert_array_equal(np.asarray(got.triangle)[clear], ids[clear])
    np.testing.assert_allclose(np.asarray(got.depth)[clear], depth[clear], rtol=1e-3)
