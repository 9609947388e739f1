"""The feature extractor: convolutions against the direct sum, gradients, random weights."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads

from jaxface.networks.convolution.conv3x3 import (
    METHODS,
    conv3x3,
    conv3x3_relu,
    direct_conv3x3,
    prepared_kernel,
)
from jaxface.networks.convolution.shifted_sum import (
    shifted_sum_conv3x3,
    shifted_sum_conv3x3_transpose,
)
from jaxface.networks.convolution.winograd import winograd_conv3x3
from jaxface.networks.texture_features.network import (
    STYLE_LAYERS,
    FeatureNetwork,
    features,
    layer_position,
    pool,
    prepare_kernels,
    with_indicator,
)
from jaxface.networks.texture_features.random_weights import SHAPES, random_network

SMALL = ((1, 6), (2, 8), (1, 8))
WIDE = ((1, 16), (2, 16))


@pytest.fixture(scope="module")
def network() -> FeatureNetwork:
    return random_network(SMALL, seed=1)


def double(tree):
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float64), tree)


def numbers(seed: int, *shape: int):
    return jnp.asarray(np.random.default_rng(seed).standard_normal(shape))


def direct_sum(x: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """Correlation written out in NumPy."""
    height, width, _ = x.shape
    padded = np.pad(x, ((1, 1), (1, 1), (0, 0)))
    return np.sum(
        [padded[i : i + height, j : j + width] @ kernel[i, j] for i in range(3) for j in range(3)],
        axis=0,
    )


@settings(max_examples=5)
@given(height=st.integers(1, 19), width=st.integers(1, 19), tiles=st.sampled_from([1, 3, 8, 500]))
def test_winograd_is_the_direct_sum_at_any_size(height, width, tiles):
    with jax.enable_x64(True):
        x, kernel = numbers(height, height, width, 3), numbers(width, 3, 3, 3, 5)
        y = winograd_conv3x3(x, kernel, tiles_at_once=tiles)
        expected = direct_sum(np.asarray(x), np.asarray(kernel))
        np.testing.assert_allclose(y, expected, atol=1e-11)
        back = winograd_conv3x3(y, kernel, transpose=True, tiles_at_once=tiles)
        assert float(jnp.vdot(back, x)) == pytest.approx(float(jnp.vdot(y, y)), rel=1e-10)


@pytest.mark.parametrize("function", [winograd_conv3x3, shifted_sum_conv3x3])
def test_bias_and_relu_in_one_pass(function, x64):
    x, kernel, bias = numbers(0, 9, 13, 2), numbers(1, 3, 3, 2, 6), numbers(2, 6)
    expected = np.maximum(direct_sum(np.asarray(x), np.asarray(kernel)) + bias, 0)
    np.testing.assert_allclose(function(x, kernel, bias), expected, atol=1e-12)


def test_gate_and_adjoints(x64):
    x, y, kernel = numbers(0, 10, 7, 2), numbers(1, 10, 7, 6), numbers(2, 3, 3, 2, 6)
    gate = x > 0
    np.testing.assert_allclose(
        winograd_conv3x3(x, kernel, gate=gate),
        direct_sum(np.where(gate, x, 0), np.asarray(kernel)),
        atol=1e-12,
    )
    expected = float(jnp.vdot(direct_conv3x3(x, kernel), y))
    for adjoint in (
        direct_conv3x3(y, kernel, transpose=True),
        shifted_sum_conv3x3_transpose(y, kernel),
        winograd_conv3x3(y, kernel, transpose=True),
    ):
        assert float(jnp.vdot(adjoint, x)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("tiles", [4, 1000])
def test_a_pixel_that_is_not_a_number_gives_no_wrong_number(tiles):
    rng = np.random.default_rng(3)
    x, kernel = rng.normal(size=(12, 16, 3)), rng.normal(size=(3, 3, 3, 2))
    x[0, 0, 0] = np.nan  # the pixel that the zero unknown to XLA is made of
    y = np.asarray(winograd_conv3x3(jnp.asarray(x), jnp.asarray(kernel), tiles_at_once=tiles))
    assert np.isnan(y[:2, :2]).all()
    plain = np.asarray(direct_conv3x3(jnp.asarray(x), jnp.asarray(kernel)))
    assert (np.isnan(y) | np.isclose(y, plain, atol=1e-4)).all()


def test_error_of_winograd_in_single_precision():
    x = numbers(0, 40, 40, 64).astype(jnp.float32)
    kernel = numbers(1, 3, 3, 64, 64).astype(jnp.float32)
    exact = direct_sum(np.asarray(x, np.float64), np.asarray(kernel, np.float64))
    scale = np.abs(exact).max()
    assert np.abs(winograd_conv3x3(x, kernel) - exact).max() < 2e-5 * scale
    assert np.abs(direct_conv3x3(x, kernel) - exact).max() < 2e-6 * scale


@pytest.mark.parametrize("method", METHODS)
def test_layer_derivatives_in_both_modes(method, x64):
    x, kernel, bias = numbers(0, 6, 5, 16), numbers(1, 3, 3, 16, 16), numbers(2, 16)
    layer = jax.jit(lambda x, k, b: conv3x3_relu(x, k, b, method))
    check_grads(layer, (x, kernel, bias), order=1, modes=["fwd", "rev"], eps=1e-6)
    linear = jax.jit(lambda x, k: conv3x3(x, k, method))
    check_grads(linear, (x, kernel), order=2, modes=["fwd", "rev"], eps=1e-3)


def test_prepared_kernels_change_nothing_but_the_time(x64):
    network = double(random_network(((1, 8), (2, 128)), seed=2))
    image, direction = numbers(0, 64, 70), numbers(1, 64, 70)
    prepared = prepare_kernels(network, image.shape)
    assert prepared_kernel(network.kernels["conv2_2"], 1023) == ()  # too small to pay
    if jax.default_backend() == "cpu":
        assert list(prepared.prepared) == ["conv2_2"]  # the only wide one

    def response(network, image):
        return features(network, image, ("conv2_2",))["conv2_2"]

    def both_modes(network):
        value, forward = jax.jvp(lambda x: response(network, x), (image,), (direction,))
        reverse = jax.grad(lambda x: jnp.sum(response(network, x) ** 2))(image)
        return value, forward, reverse

    for one, other in zip(both_modes(network), both_modes(prepared), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-11)

    def of_kernel(network):
        def loss(kernel):
            kernels = network.kernels | {"conv2_2": kernel}
            changed = dataclasses.replace(network, kernels=kernels)
            return jnp.sum(response(changed, image) ** 2)

        return jax.grad(loss)(network.kernels["conv2_2"])

    np.testing.assert_allclose(of_kernel(network), of_kernel(prepared), rtol=1e-9, atol=1e-11)


def test_layer_maps_over_images_and_kernels(x64):
    x, kernels, bias = numbers(0, 3, 6, 5, 16), numbers(1, 3, 3, 3, 16, 16), numbers(2, 16)
    both = jax.vmap(conv3x3_relu, (0, 0, None))(x, kernels, bias)
    one = jax.vmap(conv3x3_relu, (0, None, None))(x, kernels[0], bias)
    last = jax.vmap(conv3x3_relu, (3, None, None))(jnp.moveaxis(x, 0, 3), kernels[0], bias)
    for i in range(3):
        np.testing.assert_allclose(both[i], conv3x3_relu(x[i], kernels[i], bias), atol=1e-12)
        np.testing.assert_allclose(one[i], conv3x3_relu(x[i], kernels[0], bias), atol=1e-12)
    np.testing.assert_allclose(one, last, atol=1e-12)
    gradient = jax.vmap(jax.grad(lambda v: jnp.sum(conv3x3_relu(v, kernels[0], bias) ** 2)))(x)
    assert gradient.shape == x.shape and bool(jnp.all(jnp.isfinite(gradient)))


@pytest.mark.parametrize("pooling", ["average", "max"])
def test_feature_derivatives(network, pooling, x64):
    wide = double(FeatureNetwork(network.kernels, network.biases, pooling))
    image = 0.5 + 0.2 * numbers(3, 11, 14)

    @jax.jit
    def energy(picture):
        found = features(wide, picture, ("conv1_1", "conv2_2", "conv3_1"))
        return sum(jnp.sum(jnp.sin(v)) for v in found.values())

    check_grads(energy, (image,), order=1, modes=["fwd", "rev"], eps=1e-7, atol=1e-4, rtol=1e-4)
    # Forward over reverse and reverse over reverse agree: implicit derivatives need either.
    direction = numbers(4, 11, 14)
    product = jax.jit(lambda v: jax.jvp(jax.grad(energy), (v,), (direction,))[1])(image)
    other = jax.jit(jax.grad(lambda v: jnp.vdot(jax.grad(energy)(v), direction)))(image)
    np.testing.assert_allclose(product, other, atol=1e-10)


def test_methods_agree(x64):
    wide, image = double(random_network(WIDE)), 0.5 + 0.2 * numbers(3, 21, 26)
    results = [features(wide, image, wide.layers, method) for method in METHODS]
    for layer in wide.layers:
        for other in results[1:]:
            np.testing.assert_allclose(results[0][layer], other[layer], atol=1e-11)


def test_any_layers_in_any_order(network):
    image = numbers(0, 17, 23).astype(jnp.float32)
    found = features(network, image, ("conv2_2", "conv1_1"))
    assert list(found) == ["conv2_2", "conv1_1"]
    assert found["conv1_1"].shape == (17, 23, 6) and found["conv2_2"].shape == (8, 11, 8)
    batch = jax.vmap(lambda v: features(network, v, ("conv2_2",)))(jnp.stack([image, image]))
    np.testing.assert_allclose(batch["conv2_2"][1], found["conv2_2"], atol=1e-4)


def test_zeros_around_the_image_are_zeros_after_the_shift():
    # Three channels, each shifted by its own mean, then padded: what training saw.
    rng = np.random.default_rng(0)
    kernel, mean = rng.standard_normal((3, 3, 3, 4)), np.array([0.5, 0.4, 0.3])
    picture = rng.random((6, 7))
    expected = direct_sum(picture[..., None] - mean, kernel)
    folded = np.stack([kernel.sum(2), -(kernel * mean[:, None]).sum(2)], axis=2)
    found = shifted_sum_conv3x3(with_indicator(jnp.asarray(picture)), jnp.asarray(folded))
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_pooling_drops_odd_edges():
    x = jnp.arange(35.0).reshape(5, 7, 1)
    np.testing.assert_allclose(pool(x)[..., 0][0], [4, 6, 8])
    np.testing.assert_allclose(pool(x, "max")[..., 0][-1], [22, 24, 26])
    assert pool(x).shape == (2, 3, 1)


def test_random_network_is_deterministic_and_even():
    network, again, other = (random_network("compact", seed) for seed in (0, 0, 1))
    for layer in network.layers:
        np.testing.assert_array_equal(network.kernels[layer], again.kernels[layer])
    assert not np.array_equal(network.kernels["conv1_1"], other.kernels["conv1_1"])
    rng = np.random.default_rng(9)
    smooth = np.cumsum(np.cumsum(rng.standard_normal((96, 96)), 0), 1)
    smooth = 0.5 + 0.15 * (smooth - smooth.mean()) / smooth.std() + 0.03 * rng.random((96, 96))
    found = features(network, jnp.asarray(smooth, jnp.float32), network.layers)
    squares = np.array([float(jnp.mean(v**2)) for v in found.values()])
    assert squares.max() / squares.min() < 30  # unscaled normal filters differ by 1e10 and more


def test_random_network_has_no_response_to_grey():
    network = random_network(SMALL, seed=2)
    flat = features(network, jnp.full((32, 32), 0.8), network.layers)
    for layer, value in flat.items():
        middle = value[value.shape[0] // 2 - 1 :][:2]
        middle = middle[:, value.shape[1] // 2 - 1 :][:, :2]
        spread = jnp.max(jnp.ptp(middle, axis=(0, 1)))
        assert float(spread) < 1e-4 * max(1.0, float(value.max())), layer
    at_rest = jnp.maximum(network.biases["conv1_1"], 0)
    np.testing.assert_allclose(flat["conv1_1"][5, 5], at_rest, atol=1e-5)


def test_shapes_reach_the_style_layers():
    for shape in SHAPES.values():
        names = {f"conv{b}_{i + 1}" for b, (n, _) in enumerate(shape, 1) for i in range(n)}
        assert set(STYLE_LAYERS) <= names
    assert sum(n for n, _ in SHAPES["vgg19"]) == 13
    assert layer_position("conv4_12") == (4, 12)


def test_gradient_of_a_flat_image_is_finite(network):
    def energy(picture):
        return sum(jnp.sum(v**2) for v in features(network, picture, network.layers).values())

    for value in (0.0, 0.5, 1.0):
        gradient = jax.jit(jax.grad(energy))(jnp.full((16, 16), value))
        assert bool(jnp.all(jnp.isfinite(gradient)))


@pytest.mark.parametrize(
    ("layers", "shape", "message"),
    [
        (("conv4_1",), (16, 16), "has no weights for conv4_1; it has conv1_1 .. conv3_1"),
        (("relu1_1",), (16, 16), "no weights for relu1_1"),
        ((), (16, 16), "no layer"),
        (("conv3_1",), (3, 40), "3x40 pixels has no conv3_1; needed are at least 4"),
        (("conv1_1",), (16, 16, 3), "one channel"),
    ],
)
def test_wrong_requests_are_named(network, layers, shape, message):
    with pytest.raises(ValueError, match=message):
        features(network, jnp.zeros(shape), layers)


def test_wrong_arguments_are_named(network):
    with pytest.raises(ValueError, match="pooling is 'median'"):
        random_network(SMALL, pooling="median")
    with pytest.raises(ValueError, match="shape is 'vgg11'"):
        random_network("vgg11")
    with pytest.raises(ValueError, match="same layers"):
        FeatureNetwork(network.kernels, {})
    with pytest.raises(ValueError, match=r"image \(4, 4, 2\) and kernel \(3, 3, 3, 4\)"):
        conv3x3(jnp.zeros((4, 4, 2)), jnp.zeros((3, 3, 3, 4)))
    with pytest.raises(ValueError, match="method is 'fft'"):
        conv3x3(jnp.zeros((4, 4, 3)), jnp.zeros((3, 3, 3, 4)), "fft")
    with pytest.raises(ValueError, match="'conv_1' is not of the form"):
        layer_position("conv_1")
