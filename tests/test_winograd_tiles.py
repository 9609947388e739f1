"""Tiles convolved one by one: as the convolution of the image that they were cut from."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxface.networks.convolution.conv3x3 import conv3x3_relu
from jaxface.networks.convolution.winograd import transformed_kernel
from jaxface.networks.convolution.winograd_tiles import convolve_tiles
from jaxface.networks.texture_features.network import pool

SIDE = 12  # three tiles


@pytest.mark.parametrize("pooling", [None, "average", "max"])
@pytest.mark.parametrize("in_place", [False, True])
def test_as_the_whole_image(pooling, in_place):
    inputs, outputs, tiles = 6, 9, (SIDE // 4) ** 2
    rng = np.random.default_rng(0)
    image = rng.normal(size=(SIDE, SIDE, inputs)).astype(np.float32)
    kernel = rng.normal(size=(3, 3, inputs, outputs)).astype(np.float32)
    bias = rng.normal(size=outputs).astype(np.float32)
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)))
    starts = [(4 * y, 4 * x) for y in range(SIDE // 4) for x in range(SIDE // 4)]
    patches = np.stack([padded[y : y + 6, x : x + 6].reshape(36, inputs) for y, x in starts])
    memory = tuple(np.full(37 * tiles * outputs, np.nan, np.float32) for _ in range(2))
    if in_place:
        memory[0][: patches.size] = patches.reshape(-1)
        patches = memory[0][: patches.size].reshape(patches.shape)

    side = 4 if pooling is None else 2
    out = np.empty((tiles, side**2, outputs), np.float32)
    points = np.concatenate(transformed_kernel(jnp.asarray(kernel)))
    convolve_tiles(patches, points, bias, out, memory, pooling)

    true = conv3x3_relu(jnp.asarray(image), jnp.asarray(kernel), jnp.asarray(bias), "direct")
    true = np.asarray(true if pooling is None else pool(true, pooling))
    rows = out.reshape(SIDE // 4, SIDE // 4, side, side, outputs).transpose(0, 2, 1, 3, 4)
    np.testing.assert_allclose(rows.reshape(true.shape), true, atol=1e-4)
