"""Texture synthesis from an exemplar: what a small run reaches, its bounds, sizes and mistakes."""

import dataclasses
import inspect

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

import jaxface
from jaxface.cli import app, textures
from jaxface.energies.exemplar import (
    ExemplarWeights,
    exemplar_energy,
    exemplar_targets,
    octave_grams,
)
from jaxface.imaging.colour_axes import to_channels
from jaxface.networks.texture_features.random_weights import random_network
from jaxface.stages import synthesise_texture

LAYERS = ("conv1_1", "conv2_1")


@pytest.fixture(scope="module")
def network():
    return random_network(((1, 8), (1, 8)), seed=3)


def stripes(height=40, width=32):
    """Bright oblique stripes on a tinted ground."""
    y, x = np.mgrid[:height, :width]
    wave = 0.5 + 0.5 * np.tanh(4 * np.sin(2 * np.pi * (x + 0.5 * y) / 8))
    ground, bright = np.array([0.2, 0.3, 0.35]), np.array([0.8, 0.7, 0.5])
    noise = 0.05 * np.random.default_rng(0).standard_normal((height, width, 1))
    return np.clip(ground + wave[..., None] * (bright - ground) + noise, 0, 1).astype(np.float32)


@pytest.fixture(scope="module")
def made(network):
    return synthesise_texture(stripes(), network, size=(36, 44), histogram=0.1, steps=40, octaves=2)


def test_statistics_come_close_to_the_exemplars(made, network):
    exemplar = jnp.asarray(stripes())
    targets = exemplar_targets(network, exemplar, LAYERS, 2, ExemplarWeights(histogram=0.1))
    energy = exemplar_energy()

    def distance(image):
        return float(energy.value(jnp.asarray(image), targets)[0])

    noise = np.random.default_rng(1).permutation(stripes().reshape(-1, 3)).reshape(40, 32, 3)
    # The noise has the exemplar's very colours; what it lacks is their arrangement.
    assert distance(made.texture) < 0.05 * distance(noise)
    plan = [tuple(octave) for octave in targets.grams]
    found = octave_grams(network, to_channels(made.texture, targets.colours), plan)
    for octave, wanted in zip(found, targets.grams, strict=True):
        for layer, gram in wanted.items():
            assert np.linalg.norm(octave[layer] - gram) < 0.1 * np.linalg.norm(gram)


def test_the_record_tells_the_run(made):
    assert made.texture.shape == (36, 44, 3)
    assert 0 < float(made.texture.min()) and float(made.texture.max()) < 1
    assert made.sizes == ((36, 44),)
    for values in made.values:
        assert values[-1] < 0.2 * values[0] and (np.diff(values) <= 0).all()
    assert set(made.terms) == {"gram", "histogram"}
    assert sum(made.terms.values()) == pytest.approx(made.values[-1][-1], rel=1e-3)


def test_same_seed_same_picture(network):
    how = {"steps": 3, "octaves": 1}
    first, second, other = (
        np.asarray(synthesise_texture(stripes(), network, seed=seed, **how).texture)
        for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(first, second)
    assert np.abs(first - other).max() > 0.05


def test_the_answer_is_that_of_a_louder_network(network, x64):
    """Alpha against the histogram is the same for networks of any loudness."""
    factors, before, kernels, biases = (50.0, 0.02), 1.0, {}, {}
    for name, factor in zip(network.layers, factors, strict=True):
        kernels[name] = network.kernels[name] * (factor / before)
        biases[name] = network.biases[name] * factor
        before = factor
    louder = dataclasses.replace(network, kernels=kernels, biases=biases)
    one, two = (
        synthesise_texture(stripes(), n, alpha=3.0, histogram=0.5, steps=8, octaves=1)
        for n in (network, louder)
    )
    np.testing.assert_allclose(one.texture, two.texture, atol=1e-4)
    assert one.texture.dtype == np.float64


def test_coarse_to_fine(network):
    """Each level starts from the one before."""
    grey = stripes(64, 70)[..., :1]
    steps = []
    found = synthesise_texture(
        grey[..., 0], network, steps=12, octaves=1,
        on_step=lambda done, of: steps.append((done, of)),
    )  # fmt: skip
    assert found.texture.shape == (64, 70, 1)
    assert found.sizes == ((32, 35), (64, 70))
    assert found.values[1][0] < 0.7 * found.values[0][0]
    assert steps[-1][1] == 24 and [done for done, _ in steps] == sorted(done for done, _ in steps)


def test_the_histogram_is_matched_where_it_is_asked_for(network):
    exemplar = stripes()
    wanted = np.sort(exemplar.sum(-1).ravel())

    def apart(weight):
        image = synthesise_texture(
            exemplar, network, histogram=weight, steps=25, octaves=1, seed=2
        ).texture
        return np.abs(np.sort(np.asarray(image).sum(-1).ravel()) - wanted).mean()

    assert apart(1.0) < 0.6 * apart(0.0)


def test_grey_stays_grey(network):
    grey = np.repeat(stripes()[..., :1], 3, axis=-1)
    texture = np.asarray(synthesise_texture(grey, network, steps=3, octaves=1).texture)
    assert np.ptp(texture, axis=-1).max() < 1e-5 < np.ptp(texture)


def test_a_texture_may_be_smaller_than_its_exemplar(network):
    found = synthesise_texture(stripes(80, 72), network, size=32, steps=2)
    assert found.texture.shape == (32, 32, 3)


@pytest.mark.parametrize(
    ("image", "options", "said"),
    [
        (np.full((40, 40, 3), np.nan), {}, "not finite"),
        (np.zeros((40, 40, 2)), {}, r"shape \(40, 40, 2\)"),
        (np.zeros((40, 20, 3)), {}, "40x20 px; at least 32"),
        (255 * stripes(), {}, "divide 8-bit values by 255"),
        (np.full((40, 40), 0.5), {}, "the same everywhere"),
        (stripes(), {"layers": ("conv3_1",)}, "no weights for conv3_1"),
        (stripes(), {"layers": ()}, "no layer"),
        (stripes(), {"size": 8}, "size is 8"),
        (stripes(), {"size": (64, 8)}, r"size is \(64, 8\)"),
        (stripes(), {"alpha": -1.0}, "alpha is -1"),
        (stripes(), {"alpha": 0.0, "histogram": 0.0}, "at least one"),
        (stripes(), {"histogram": float("nan")}, "histogram is nan"),
        (stripes(), {"steps": 0}, "steps is 0"),
    ],
)
def test_mistakes_are_told(network, image, options, said):
    with pytest.raises(ValueError, match=said):
        synthesise_texture(image, network, **options)


def test_a_layer_that_does_not_fit_is_told():
    deep = random_network(((1, 4), (1, 4), (1, 4), (1, 4)), seed=0)
    with pytest.raises(ValueError, match="at least 64"):
        synthesise_texture(stripes(), deep, layers=("conv1_1", "conv4_1"))


def test_the_command_writes_a_picture(tmp_path, network):
    from jaxface.io.feature_weights import save_network

    save_network(tmp_path / "net.npz", network)
    Image.fromarray((255 * stripes()).astype(np.uint8)).save(tmp_path / "in.png")
    arguments = ["synthesise", str(tmp_path / "in.png"), "-o", str(tmp_path / "out.png")]
    options = ["--features", str(tmp_path / "net.npz"), "--size", "32x48", "--steps", "3"]
    answer = CliRunner().invoke(app, [*arguments, *options, "--octaves", "1"])
    assert answer.exit_code == 0, answer.output
    with Image.open(tmp_path / "out.png") as written:
        assert written.size == (48, 32)
    wrong = CliRunner().invoke(app, [*arguments, "--size", "huge"])
    assert wrong.exit_code == 2 and "512x768" in wrong.output


def test_the_command_has_the_functions_defaults():
    of_function = inspect.signature(synthesise_texture).parameters
    of_command = inspect.signature(textures.synthesise).parameters
    for name in ("alpha", "histogram", "octaves", "seed", "layers", "size"):
        assert of_command[name].default == of_function[name].default, name
    assert of_command["steps_"].default == of_function["steps"].default
    assert jaxface.synthesise_texture is synthesise_texture
