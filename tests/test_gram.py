"""Gramians and the energies of eq. 3: definition, gradients, tiles, singular points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax.test_util import check_grads

from jaxface.energies._gram import (
    StyleData,
    StyleTargets,
    feature_loss,
    gram,
    gram_loss,
    grams,
    mask_out,
    style_energy,
    style_value_and_grad,
)
from jaxface.networks.texture_features.network import STYLE_LAYERS, FeatureNetwork, features
from jaxface.networks.texture_features.random_weights import random_network
from jaxface.networks.texture_features.tiles import LARGEST_TILE, even_tile, tiling

SHAPE = ((2, 6), (1, 8), (2, 8))
WIDE = ((1, 16), (2, 16))
LAYERS = ("conv1_1", "conv2_1", "conv3_2")

value_and_grad = jax.jit(style_value_and_grad, static_argnames=("tile", "method"))
grams_of = jax.jit(grams, static_argnames=("layers", "tile"))
features_of = jax.jit(features, static_argnums=2)


@pytest.fixture(scope="module")
def network() -> FeatureNetwork:
    return random_network(SHAPE, seed=1)


def double(tree):
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float64), tree)


def picture(seed: int, *shape: int):
    return jnp.asarray(np.random.default_rng(seed).random(shape))


def targets_of(network: FeatureNetwork, image, map_layers=("conv2_1", "conv3_1")) -> StyleTargets:
    return StyleTargets(
        grams_of(image, network, layers=LAYERS),
        features_of(network, image, map_layers),
        alpha=30.0,
        gram_weights={"conv3_2": 0.25},
        feature_weights={"conv2_1": 2.0},
    )


@given(
    seed=st.integers(0, 1000),
    height=st.integers(1, 6),
    width=st.integers(1, 6),
    channels=st.integers(1, 5),
)
def test_gram_is_a_second_moment(seed, height, width, channels):
    rng = np.random.default_rng(seed)
    values = rng.standard_normal((height, width, channels)).astype(np.float32)
    found = np.asarray(gram(jnp.asarray(values)))
    flat = values.reshape(-1, channels).astype(np.float64)
    np.testing.assert_allclose(found, flat.T @ flat / len(flat), atol=1e-5)
    assert np.linalg.eigvalsh(found.astype(np.float64)).min() > -1e-5
    shuffled = rng.permutation(values.reshape(-1, channels)).reshape(values.shape)
    np.testing.assert_allclose(gram(jnp.asarray(shuffled)), found, atol=1e-5)


def test_gram_derivatives(x64):
    values = jnp.asarray(np.random.default_rng(0).standard_normal((4, 5, 3)))
    check_grads(gram, (values,), order=2, modes=["fwd", "rev"], eps=1e-4)


def test_mask_out_is_half_where_not_visible():
    image = jnp.array([[0.1, 0.9], [0.3, 0.2]])
    visible = jnp.array([[True, False], [False, True]])
    np.testing.assert_allclose(mask_out(image, visible), [[0.1, 0.5], [0.5, 0.2]])
    gradient = jax.grad(lambda v: jnp.sum(mask_out(v, visible)))(image)
    np.testing.assert_array_equal(gradient, visible)


def test_energy_is_equation_3(network, x64):
    wide, image = double(network), picture(0, 13, 18)
    targets = targets_of(wide, picture(1, 13, 18))
    found = features_of(wide, image, ("conv1_1", "conv2_1", "conv3_1", "conv3_2"))
    expected = 0.0
    for layer, target in targets.grams.items():
        flat = np.asarray(found[layer]).reshape(-1, target.shape[0])
        weight = targets.gram_weights.get(layer, 1.0)
        distance = np.linalg.norm(flat.T @ flat / len(flat) - np.asarray(target)) ** 2
        expected += 30 * weight * distance
    for layer, target in targets.features.items():
        weight = targets.feature_weights.get(layer, 1.0)
        expected += weight * np.linalg.norm(np.asarray(found[layer] - target)) ** 2
    assert float(style_energy(image, StyleData(wide, targets))) == pytest.approx(
        expected, rel=1e-10
    )
    assert float(style_energy(picture(1, 13, 18), StyleData(wide, targets))) == pytest.approx(
        0, abs=1e-20
    )


@pytest.mark.parametrize("tile", [None, 8])
def test_energy_derivatives(network, tile, x64):
    wide, image = double(network), picture(0, 13, 18)
    targets = targets_of(wide, picture(1, 13, 18))
    energy = jax.jit(lambda v: style_energy(v, StyleData(wide, targets), tile=tile))
    check_grads(energy, (image,), order=1, modes=["fwd", "rev"], eps=1e-6, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(
    ("pooling", "shape", "tile"),
    [("average", (24, 40), 8), ("max", (17, 35), 16), ("average", (13, 18), 4)],
)
def test_tiles_change_nothing(network, pooling, shape, tile, x64):
    wide = double(FeatureNetwork(network.kernels, network.biases, pooling))
    image, targets = picture(0, *shape), targets_of(wide, picture(1, *shape))
    value, gradient = value_and_grad(image, StyleData(wide, targets))
    tiled_value, tiled_gradient = value_and_grad(image, StyleData(wide, targets), tile=tile)
    assert float(tiled_value) == pytest.approx(float(value), rel=1e-12)
    np.testing.assert_allclose(tiled_gradient, gradient, atol=1e-12 * float(abs(gradient).max()))
    tiled = grams_of(image, wide, layers=LAYERS, tile=tile)
    for layer, whole in grams_of(image, wide, layers=LAYERS).items():
        np.testing.assert_allclose(tiled[layer], whole, rtol=1e-11, atol=1e-13)


@given(height=st.integers(1, 9000), width=st.integers(1, 9000))
def test_even_tiles_cover_with_little_overhang(height, width):
    tile = even_tile((height, width))
    count = -(-max(height, width) // tile)
    assert tile % 16 == 0 and tile <= LARGEST_TILE
    assert count == -(-max(height, width) // LARGEST_TILE)
    assert count * tile - max(height, width) < 16 * count


def test_tiles_in_single_precision():
    network = random_network(WIDE)
    image, other = (picture(i, 45, 70).astype(jnp.float32) for i in range(2))
    layers = ("conv1_1", "conv2_2")
    targets = StyleTargets(
        grams_of(other, network, layers=layers), features_of(network, other, layers[1:])
    )
    value, gradient = value_and_grad(image, StyleData(network, targets))
    tiled_value, tiled_gradient = value_and_grad(image, StyleData(network, targets), tile=32)
    assert float(tiled_value) == pytest.approx(float(value), rel=1e-5)
    # A response that rounding moves across zero switches its whole gradient on or off.
    error = jnp.linalg.norm(tiled_gradient - gradient) / jnp.linalg.norm(gradient)
    assert float(error) < 5e-3


def test_tiles_bound_the_memory(network):
    def temporary(side: int, tile: int | None) -> int:
        image = jax.ShapeDtypeStruct((side, side), jnp.float32)
        targets = StyleTargets(grams_of(jnp.zeros((16, 16)), network, layers=LAYERS))
        program = value_and_grad.lower(image, StyleData(network, targets), tile=tile).compile()
        return program.memory_analysis().temp_size_in_bytes - 4 * 4 * side**2  # less some images

    assert temporary(512, 64) < 1.5 * temporary(256, 64) < 0.5 * temporary(512, None)


def test_a_tile_takes_what_is_said():
    network = random_network("vgg19")
    targets = StyleTargets({name: jnp.eye(network.channels[name]) for name in STYLE_LAYERS})
    image = jax.ShapeDtypeStruct((2 * LARGEST_TILE,) * 2, jnp.float32)
    program = value_and_grad.lower(image, StyleData(network, targets), tile=LARGEST_TILE).compile()
    assert program.memory_analysis().temp_size_in_bytes < 1.75e9


@pytest.mark.parametrize("tile", [None, 8])
def test_singular_images_have_finite_gradients(network, tile):
    shape = (20, 24)
    targets = targets_of(network, picture(1, *shape).astype(jnp.float32))
    hidden = mask_out(picture(0, *shape).astype(jnp.float32), jnp.zeros(shape, bool))
    for image in (hidden, jnp.zeros(shape), jnp.ones(shape)):
        value, gradient = value_and_grad(image, StyleData(network, targets), tile=tile)
        assert bool(jnp.isfinite(value)) and bool(jnp.all(jnp.isfinite(gradient)))
    zero = {layer: jnp.zeros_like(g) for layer, g in targets.grams.items()}
    assert bool(jnp.all(jnp.isfinite(jax.grad(lambda g: gram_loss(g, zero))(zero)["conv1_1"])))


def test_gradient_with_respect_to_targets_and_weights(network, x64):
    wide, image = double(network), picture(0, 12, 12)
    targets = targets_of(wide, picture(1, 12, 12))
    slope = jax.grad(lambda t: style_energy(image, StyleData(wide, t)))(targets)
    assert float(slope.alpha) == pytest.approx(
        float(gram_loss(grams_of(image, wide, layers=LAYERS), targets.grams, targets.gram_weights)),
        rel=1e-9,
    )
    found = grams_of(image, wide, layers=LAYERS)
    expected = 2 * 30 * 0.25 * (targets.grams["conv3_2"] - found["conv3_2"])
    np.testing.assert_allclose(slope.grams["conv3_2"], expected, rtol=1e-9)


def test_energies_map_over_images(network):
    images = picture(0, 2, 12, 12).astype(jnp.float32)
    targets = targets_of(network, picture(1, 12, 12).astype(jnp.float32))
    together = jax.vmap(lambda v: style_energy(v, StyleData(network, targets)))(images)
    one = style_energy(images[1], StyleData(network, targets))
    assert float(together[1]) == pytest.approx(float(one), rel=1e-4)


def test_wrong_arguments_are_named(network):
    image = jnp.zeros((24, 24))
    with pytest.raises(ValueError, match="tile is 6; needed is a positive multiple of 4"):
        grams_of(image, network, layers=LAYERS, tile=6)
    with pytest.raises(ValueError, match="no weights for conv4_1"):
        tiling(network, (24, 24), ("conv4_1",), 16)
    with pytest.raises(ValueError, match=r"Gram target of conv1_1 has shape \(2, 2\)"):
        style_energy(image, StyleData(network, StyleTargets({"conv1_1": jnp.zeros((2, 2))})))
    targets = StyleTargets({}, {"conv2_1": jnp.zeros((3, 3, 8))})
    for tile in (None, 8):
        with pytest.raises(ValueError, match=r"conv2_1 has shape \(3, 3, 8\); needed is \(12, 12"):
            style_energy(image, StyleData(network, targets), tile=tile)
    with pytest.raises(ValueError, match="feature target is given for conv1_1"):
        feature_loss({}, {"conv1_1": image})
