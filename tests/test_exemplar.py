"""The statistics that a texture shares with its exemplar: definition, scale, gradients."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxface.energies.exemplar import (
    ExemplarWeights,
    exemplar_energy,
    exemplar_targets,
    layers_by_octave,
)
from jaxface.imaging.colour_axes import colour_axes, to_channels
from jaxface.networks.texture_features.network import FeatureNetwork, features
from jaxface.networks.texture_features.random_weights import random_network

LAYERS = ("conv1_1", "conv2_1")
WEIGHTS = ExemplarWeights(2.0, 0.25)
ENERGY = exemplar_energy()
value_of = jax.jit(ENERGY.value)


@pytest.fixture(scope="module")
def network() -> FeatureNetwork:
    return random_network(((1, 4), (1, 6)), seed=2)


def double(tree):
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float64), tree)


def picture(seed: int, *shape: int):
    """Colours along one diagonal line, with some off it."""
    rng = np.random.default_rng(seed)
    along, across = rng.random((*shape, 1)), rng.random((*shape, 3))
    colour = np.array([0.7, 0.5, 0.2])
    return jnp.asarray(0.1 + 0.6 * along * colour + 0.2 * across, jnp.result_type(float))


def louder(network: FeatureNetwork, factors) -> FeatureNetwork:
    """Every layer's responses times a factor of its own."""
    kernels, biases, before = {}, {}, 1.0
    for name, factor in zip(network.layers, factors, strict=True):
        kernels[name] = network.kernels[name] * (factor / before)
        biases[name] = network.biases[name] * factor
        before = factor
    return FeatureNetwork(kernels, biases, network.pooling)


def test_energy_is_its_definition(network, x64):
    """Of a grey picture, written out in NumPy: two octaves, every quantile."""
    wide = double(network)
    rng = np.random.default_rng(0)
    exemplar, image = (jnp.asarray(rng.random((16, 20, 1))) for _ in range(2))
    targets = exemplar_targets(wide, exemplar, LAYERS, 2, WEIGHTS)
    total, terms = ENERGY.value(image, targets)

    def halved(x):
        return x.reshape(8, 2, 10, 2).mean(axis=(1, 3))

    distances = []
    for octave, layer in ((0, "conv1_1"), (0, "conv2_1"), (1, "conv1_1")):
        pair = []
        for x in (image, exemplar):
            x = np.asarray(x[..., 0])
            seen = features(wide, jnp.asarray(halved(x) if octave else x), [layer])[layer]
            flat = np.asarray(seen).reshape(-1, seen.shape[2])
            pair.append(flat.T @ flat / len(flat))
        distances.append(((pair[0] - pair[1]) ** 2).sum() / (pair[1] ** 2).sum())
    assert float(terms["gram"]) == pytest.approx(2.0 * np.mean(distances), rel=1e-10)

    sorted_apart = np.sort(np.ravel(image)) - np.sort(np.ravel(exemplar))
    expected = 0.25 * np.mean(sorted_apart**2) / np.var(np.asarray(exemplar))
    assert float(terms["histogram"]) == pytest.approx(expected, rel=1e-10)
    assert float(total) == pytest.approx(sum(map(float, terms.values())), rel=1e-12)


def test_energy_vanishes_on_the_exemplar_and_is_one_far_from_it(network):
    exemplar = picture(0, 24, 24)
    targets = exemplar_targets(network, exemplar, LAYERS, 2, WEIGHTS)
    assert float(value_of(exemplar, targets)[0]) < 1e-9
    grey = jnp.broadcast_to(jnp.mean(exemplar, axis=(0, 1)), exemplar.shape)
    terms = value_of(grey, targets)[1]
    assert float(terms["histogram"]) == pytest.approx(0.25, rel=1e-3)


def test_alpha_means_the_same_for_loud_and_for_quiet_networks(network, x64):
    wide = double(network)
    exemplar, image = picture(0, 16, 16), picture(1, 16, 16) ** 2
    targets = exemplar_targets(wide, exemplar, LAYERS, 2, WEIGHTS)
    other = exemplar_targets(louder(wide, (100.0, 0.01)), exemplar, LAYERS, 2, WEIGHTS)
    gradient = jax.jit(jax.grad(lambda i, t: ENERGY.value(i, t)[0]))
    assert float(value_of(image, targets)[0]) == pytest.approx(
        float(value_of(image, other)[0]), rel=1e-10
    )
    np.testing.assert_allclose(gradient(image, targets), gradient(image, other), rtol=1e-8)


def test_statistics_hardly_depend_on_the_size(network):
    """Of one endless pattern, cut out at two sizes; the border has more of the smaller one."""
    tile = np.random.default_rng(0).random((8, 8, 1)).astype(np.float32)
    large = jnp.asarray(np.tile(tile, (12, 12, 1)))
    targets = exemplar_targets(network, large[:72, :72], LAYERS, 2, ExemplarWeights())
    energy = jax.jit(exemplar_energy(histogram=False).value)
    same, other = (float(energy(x, targets)[0]) for x in (large, large**3))
    assert same < 0.003 and other > 50 * same


@pytest.mark.parametrize("kind", ["random", "singular"])
def test_derivatives(network, kind, x64):
    """In both modes against differences; also where every pixel is equal and nothing responds."""
    wide = double(network)
    targets = exemplar_targets(wide, picture(0, 16, 16), LAYERS, 2, WEIGHTS)
    image = picture(1, 16, 16) if kind == "random" else jnp.full((16, 16, 3), 0.5)
    energy = jax.jit(lambda i, w: ENERGY.value(i, dataclasses.replace(targets, weights=w))[0])
    weights = double(WEIGHTS)
    if kind == "random":
        check_grads(energy, (image, weights), 1, ("fwd", "rev"), eps=1e-7, atol=1e-6, rtol=1e-5)
        return
    # A kink of the ReLUs and of the order of equals: a derivative there, the same in both modes.
    gradient = jax.grad(energy)(image, weights)
    assert bool(jnp.isfinite(gradient).all())
    direction = picture(2, 16, 16) - 0.5
    forward = jax.jvp(lambda i: energy(i, weights), (image,), (direction,))[1]
    assert float(forward) == pytest.approx(float(jnp.sum(gradient * direction)), rel=1e-10)


def test_statistics_of_nothing_have_finite_derivatives(network):
    exemplar = picture(0, 16, 16)
    targets = exemplar_targets(network, exemplar, LAYERS, 1, WEIGHTS)
    kept = ("network", "colours", "weights")
    silent = dataclasses.replace(
        jax.tree.map(jnp.zeros_like, targets),
        **{name: jax.tree.map(jnp.asarray, getattr(targets, name)) for name in kept},
    )
    slope = jax.grad(lambda t: ENERGY.value(exemplar, t)[0])(silent)
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(slope))


def test_layers_of_an_octave_are_those_that_fit():
    assert layers_by_octave((32, 40), ("conv1_1", "conv3_1"), 5) == (
        ("conv1_1", "conv3_1"), ("conv1_1",), ("conv1_1",),
    )  # fmt: skip
    assert layers_by_octave((16, 16), ("conv3_1",), 2) == ()


def test_colours_lie_along_their_axes():
    image = picture(0, 24, 24)
    found = colour_axes(image)
    channels = np.asarray(to_channels(image, found)).reshape(-1, len(found.gains))
    covariance = np.cov(channels, rowvar=False, bias=True)
    assert np.abs(covariance - np.diag(np.diag(covariance))).max() < 1e-5
    assert channels[:, 0].mean() == pytest.approx(
        float(np.asarray(image).mean((0, 1)) @ [0.299, 0.587, 0.114]), abs=1e-5
    )
    np.testing.assert_allclose(found.axes @ found.axes.T, np.eye(len(found.gains)), atol=1e-6)


def test_a_grey_picture_has_one_channel_its_intensity():
    grey = jnp.asarray(np.random.default_rng(0).random((12, 12, 1)), jnp.float32)
    for image in (grey, jnp.repeat(grey, 3, axis=-1)):
        found = colour_axes(image)
        channels = to_channels(image, found)
        assert channels.shape == (12, 12, 1)
        np.testing.assert_allclose(channels, grey, atol=1e-6)


def test_a_picture_that_is_too_small_is_told(network):
    with pytest.raises(
        ValueError, match="10x12 px, the picture 10x12; for the layers .* at least 16 px"
    ):
        exemplar_targets(network, picture(0, 10, 12), ("conv2_1",), 1, WEIGHTS)
    with pytest.raises(ValueError, match="no weights for conv3_1"):
        exemplar_targets(network, picture(0, 16, 16), ("conv3_1",), 1, WEIGHTS)
