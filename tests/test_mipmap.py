"""Mipmaps and smooth filling."""

import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.ndimage import map_coordinates

from jaxface.imaging.mipmap import mipmap
from jaxface.imaging.push_pull import push_pull


def test_bilinear_agrees_with_scipy():
    rng = np.random.default_rng(0)
    image = rng.random((9, 13, 2)).astype(np.float32)
    points = rng.uniform(-2, 15, (200, 2)).astype(np.float32)
    at = [points[:, 1] - 0.5, points[:, 0] - 0.5]
    expected = [map_coordinates(image[..., k], at, order=1, mode="nearest") for k in (0, 1)]
    ours = mipmap(jnp.asarray(image)).bilinear(jnp.asarray(points))
    np.testing.assert_allclose(ours, np.stack(expected, -1), atol=1e-5)


@pytest.mark.parametrize("shape", [(64, 64), (61, 47)])
def test_every_level_of_a_ramp_is_the_ramp(shape):
    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    ramp = jnp.asarray(np.stack([2 * x - y], -1))
    pyramid = mipmap(ramp, 4)
    points = jnp.asarray(np.random.default_rng(1).uniform(10, 32, (50, 2)))
    level = jnp.linspace(-1.0, 2.9, 50)
    sample = pyramid.trilinear(points, level)
    np.testing.assert_allclose(sample[:, 0], 2 * points[:, 0] - points[:, 1], atol=1e-3)


def test_a_coarse_level_removes_what_a_texel_cannot_show():
    stripes = jnp.tile(jnp.array([0.0, 1.0]), (32, 16))[..., None]
    points = jnp.stack([jnp.linspace(8, 24, 40), jnp.full(40, 16.0)], -1)
    sharp = mipmap(stripes).trilinear(points, jnp.zeros(40))
    blurred = mipmap(stripes).trilinear(points, jnp.ones(40))
    assert jnp.ptp(sharp) > 0.5
    np.testing.assert_allclose(blurred, 0.5, atol=1e-6)


def test_level_beyond_the_last_and_tiny_images():
    image = jnp.arange(6.0).reshape(2, 3, 1)
    assert mipmap(image).shapes == ((2, 3),)
    pyramid = mipmap(jnp.ones((8, 8, 1)))
    assert pyramid.coarsest == 2
    np.testing.assert_allclose(pyramid.trilinear(jnp.full((3, 2), 4.0), jnp.full(3, 9.0)), 1.0)
    assert mipmap(jnp.ones((1, 1, 2))).bilinear(jnp.zeros((1, 2))).tolist() == [[1.0, 1.0]]
    with pytest.raises(ValueError, match="levels is 0"):
        mipmap(image, 0)


def test_gradient_of_a_sample(x64):
    image = jnp.asarray(np.random.default_rng(2).random((10, 10, 1)))
    level = jnp.array([0.3, 1.2])

    def total(im, points):
        return jnp.sum(jnp.sin(mipmap(im).trilinear(points, level)))

    points = jnp.array([[3.3, 4.1], [6.2, 5.8]])
    check_grads(total, (image, points), order=1, modes=("fwd", "rev"))


def test_push_pull_keeps_the_known_and_continues_it():
    rng = np.random.default_rng(3)
    known = rng.random((45, 70)) < 0.1
    x = np.linspace(0, 1, 70) * np.ones((45, 1))
    values = np.stack([x, np.full_like(x, 0.7)], -1)
    filled = np.asarray(push_pull(jnp.asarray(values * known[..., None]), jnp.asarray(known * 1.0)))
    np.testing.assert_allclose(filled[known], values[known], atol=1e-6)
    np.testing.assert_allclose(filled[..., 1], 0.7, atol=1e-5)
    assert np.abs(filled[..., 0] - x).max() < 0.15
    assert (push_pull(jnp.ones((5, 5, 1)), jnp.zeros((5, 5))) == 0).all()
