"""Responses to a constant image from small maps: as the network computes them."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxface.networks.texture_features.constant_response import constant_maps
from jaxface.networks.texture_features.network import blocks_up_to, features
from jaxface.networks.texture_features.random_weights import random_network

LAYERS = ("conv1_1", "conv1_2", "conv2_1", "conv3_1", "conv3_2", "conv3_3", "conv4_1")
SHAPE = ((2, 4), (1, 6), (3, 5), (1, 6))
COLUMNS = 97


@pytest.mark.parametrize("pooling", ["average", "max"])
@pytest.mark.parametrize("height", [8, 13, 44, 63, 80, 87])
def test_as_the_network_responds(height, pooling):
    network = random_network(SHAPE, seed=1, pooling=pooling)
    maps = constant_maps(network, blocks_up_to(network, LAYERS), 0.5, (height, COLUMNS))
    true = features(network, jnp.full((height, COLUMNS), 0.5), LAYERS)
    for name, response in true.items():
        response = np.asarray(response)
        assert maps[name].shape == response.shape[:2]
        found = maps[name].at(np.arange(response[..., 0].size)).reshape(response.shape)
        np.testing.assert_allclose(found, response, atol=2e-5 * response.max(), err_msg=name)


def test_small_maps_do_not_grow_with_the_image():
    network = random_network(SHAPE, seed=1)
    large = constant_maps(network, blocks_up_to(network, LAYERS), 0.5, (4096, 8192))
    assert max(value.values.shape[1] for value in large.values()) < 16


def test_counts_what_each_pixel_stands_for():
    network = random_network(SHAPE, seed=1)
    whole = constant_maps(network, blocks_up_to(network, LAYERS), 0.5, (61, COLUMNS))["conv1_2"]
    where = np.random.default_rng(0).random(whole.shape) < 0.3
    total = np.einsum("yx,yxn->n", whole.count(where), whole.values)
    true = whole.at(np.flatnonzero(where)).sum(axis=0, dtype=np.float64)
    np.testing.assert_allclose(total, true, rtol=1e-6)
    assert whole.count(where).sum() == where.sum()
