"""Training of feature networks, its command's pipeline, and the bundled weights."""

import itertools
import json
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxface.energies._gram import grams
from jaxface.io.feature_weights import load_network
from jaxface.io.formats.image import write_png
from jaxface.networks.texture_features.network import STYLE_LAYERS, FeatureNetwork
from jaxface.networks.texture_features.random_weights import natural_noise, random_network
from jaxface.pipeline.training import features as feature_training
from jaxface.pipeline.training.features import folder_pictures, train_features
from jaxface.training.features import (
    CROP,
    TRAINING_ROWS,
    VALIDATION_ROWS,
    batch_grams,
    contrastive_loss,
    crop_pairs,
    equalised,
    identification,
    relative_distances,
    start_training,
    train,
)

TINY = ((1, 4), (1, 4), (1, 4), (1, 4), (1, 4))
SIDE = 4 * CROP


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    """Gratings of several directions and wavelengths in noise."""
    generator = np.random.default_rng(0)
    y, x = np.mgrid[:SIDE, :SIDE]
    found = []
    for index in range(6):
        angle, wavelength = np.pi * index / 6, 4 + 2 * (index % 3)
        phase = 2 * np.pi * (x * np.cos(angle) + y * np.sin(angle)) / wavelength
        noise = generator.standard_normal((SIDE, SIDE))
        found.append(np.clip(0.5 + 0.15 * np.sin(phase) + 0.08 * noise, 0, 1).astype(np.float32))
    return found


def run(pictures, steps, seed=0, take=None, state=None):
    made = train(pictures, steps, seed, batch=6, shape=TINY, state=state)
    return list(itertools.islice(made, take))


@pytest.fixture(scope="module")
def states(pictures):
    return run(pictures, 40)


def assert_same(first, second) -> None:
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


def test_the_loss_falls(pictures, states) -> None:
    crops = jnp.asarray(crop_pairs(pictures, 6, np.random.default_rng(99), VALIDATION_ROWS))
    loss = jax.jit(contrastive_loss)
    before = float(loss(start_training(TINY, 0, 40).learner, crops))
    assert float(loss(states[-1].learner, crops)) < 0.9 * before
    losses = states[-1].losses
    assert len(losses) == 40
    assert np.mean(losses[-5:]) < 0.9 * np.mean(losses[:5])


def test_same_seed_same_weights_and_resuming_changes_nothing(pictures, states) -> None:
    again = run(pictures, 40, take=15)
    assert_same(again[-1].learner, states[14].learner)
    resumed = run(pictures, 40, state=again[-1], take=10)
    assert resumed[-1].step == 25
    assert resumed[-1].losses == states[24].losses
    assert_same(resumed[-1].learner, states[24].learner)
    other = run(pictures, 40, seed=1, take=1)
    assert other[0].losses != states[0].losses


def test_grams_of_a_batch_are_those_of_each_image(pictures) -> None:
    network = random_network(TINY)
    images = jnp.asarray(crop_pairs(pictures, 2, np.random.default_rng(0))[0])
    found = batch_grams(network, images)
    for index, image in enumerate(images):
        for name, gram in grams(image, network, method="direct").items():
            np.testing.assert_allclose(found[name][index], gram, rtol=1e-4, atol=1e-5)


def test_relative_distances_know_no_scale() -> None:
    a, b = np.random.default_rng(0).random((2, 3, 4, 4)).astype(np.float32)
    found = relative_distances(jnp.asarray(a), jnp.asarray(b))
    norm = partial(np.linalg.norm, axis=(-2, -1))
    expected = norm(a[:, None] - b) ** 2 / (norm(a)[:, None] * norm(b))
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    np.testing.assert_allclose(relative_distances(7 * a, 7 * b), expected, rtol=1e-4)
    np.testing.assert_allclose(np.diag(relative_distances(a, a)), 0, atol=1e-6)


def test_equalised_layers_are_equally_loud_and_tell_the_same(pictures, states) -> None:
    network = states[-1].learner.network
    network = FeatureNetwork(
        network.kernels, {name: b + 0.1 for name, b in network.biases.items()}, network.pooling
    )
    same = equalised(network)
    assert_equally_loud(same)
    crops = jnp.asarray(crop_pairs(pictures, 4, np.random.default_rng(3)))
    for name in STYLE_LAYERS:
        before, after = (
            relative_distances(*(batch_grams(n, side)[name] for side in crops))
            for n in (network, same)
        )
        np.testing.assert_allclose(after, before, rtol=1e-3, atol=1e-5)
    assert identification(same, pictures, 12) == identification(network, pictures, 12)


def assert_equally_loud(network, tolerance=1e-3) -> None:
    picture = jnp.asarray(natural_noise(128, np.random.default_rng(0)), jnp.float32)
    for name, gram in grams(picture, network, layers=network.layers, method="direct").items():
        assert float(jnp.mean(jnp.diag(gram))) == pytest.approx(1, abs=tolerance), name


def test_crops_keep_to_their_rows_and_lie_side_by_side() -> None:
    y, x = np.mgrid[:SIDE, :SIDE]
    pictures = [(y / SIDE).astype(np.float32), (x / SIDE).astype(np.float32)]
    for rows in (TRAINING_ROWS, VALIDATION_ROWS):
        crops = crop_pairs(pictures, 8, np.random.default_rng(0), rows, vary=False)
        assert crops.shape == (2, 8, CROP, CROP)
        upright = np.ptp(crops, axis=2).max(axis=(0, 2)) > 0  # of the first picture
        assert upright.sum() == 4, "each picture as often"
        inside = crops[:, upright]
        assert inside.min() >= rows[0]
        assert inside.max() < rows[1]
        first, second = crops[:, ~upright]
        np.testing.assert_allclose(second - first, CROP / SIDE, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"pictures": 1}, "at least 2"),
        ({"picture": np.zeros((100, 500), np.float32)}, "needed is one channel"),
        ({"picture": np.zeros((300, 300, 3), np.float32)}, "needed is one channel"),
        ({"picture": np.full((300, 300), np.nan, np.float32)}, "not finite"),
        ({"steps": 0}, "steps is 0"),
        ({"batch": 1}, "batch is 1"),
        ({"shape": ((1, 4), (1, 4))}, "five blocks"),
    ],
)
def test_bad_inputs(pictures, change, said) -> None:
    settings = {"steps": 2, "batch": 2, "shape": TINY} | change
    given = pictures[: settings.pop("pictures", 6)]
    if "picture" in settings:
        given = [*given, settings.pop("picture")]
    with pytest.raises(ValueError, match=said):
        next(train(given, **settings))


@pytest.fixture
def folder(tmp_path, pictures):
    path = tmp_path / "pictures"
    path.mkdir()
    for index, picture in enumerate(pictures):
        write_png(path / f"{index}.png", np.repeat(picture[..., None], 3, axis=2))
    return path


def test_files_of_a_run_and_resuming_from_disk(tmp_path, folder, monkeypatch) -> None:
    monkeypatch.setattr(feature_training, "CHECKPOINT_EVERY", 2)
    settings = {"steps": 6, "skins": 0, "batch": 3, "shape": TINY}
    whole = train_features(folder, tmp_path / "whole.npz", **settings)

    class StoppedError(Exception):
        pass

    def stop(what, done, of) -> None:
        if done == 5:
            raise StoppedError

    out = tmp_path / "stopped.npz"
    with pytest.raises(StoppedError):
        train_features(folder, out, on_step=stop, **settings)
    part = out.with_suffix(".part") / "state.npz"
    assert part.is_file()
    assert not out.exists()
    seen = []
    resumed = train_features(folder, out, on_step=lambda *step: seen.append(step), **settings)
    assert seen == [("steps", 5, 6), ("steps", 6, 6)]
    assert_same(whole, resumed)
    assert not part.parent.exists()
    report = json.loads(out.with_suffix(".json").read_text())
    assert len(report["losses"]) == 6
    assert 0 <= report["identified"] <= 1
    assert "polyline" in out.with_suffix(".svg").read_text()
    read = load_network(out)
    for name in STYLE_LAYERS:
        np.testing.assert_allclose(read.kernels[name], whole.kernels[name], rtol=1e-3, atol=1e-6)


def test_a_kept_state_of_other_inputs_or_a_damaged_one_starts_anew(
    tmp_path, folder, monkeypatch
) -> None:
    def count(pictures, steps, seed, batch, shape, state):
        """In place of training, which other tests do."""
        while state.step < steps:
            state = state._replace(step=state.step + 1, losses=(*state.losses, 0.5))
            yield state

    monkeypatch.setattr(feature_training, "CHECKPOINT_EVERY", 1)
    monkeypatch.setattr(feature_training, "train", count)
    monkeypatch.setattr(feature_training, "identification", lambda network, pictures: 0.0)
    settings = {"steps": 3, "skins": 0, "batch": 2, "shape": TINY}

    class StoppedError(Exception):
        pass

    def first_step(until, **changed) -> int:
        seen = []

        def stop(what, done, of) -> None:
            seen.append(done)
            if len(seen) == until:
                raise StoppedError

        with pytest.raises(StoppedError):
            train_features(folder, tmp_path / "a.npz", on_step=stop, **settings | changed)
        return seen[0]

    assert first_step(2) == 1  # step 1 is kept
    assert first_step(1) == 2
    assert first_step(1, seed=1) == 1
    assert first_step(1, batch=3) == 1
    assert first_step(1) == 2, "a call that has kept nothing leaves what was kept"
    (tmp_path / "a.part" / "state.npz").write_bytes(b"cut off")
    with pytest.warns(UserWarning, match="state.npz is no whole checkpoint"):
        assert first_step(1) == 1


def test_bad_files(tmp_path) -> None:
    with pytest.raises(ValueError, match=r"ends in \.npz"):
        train_features(None, tmp_path / "weights.txt")
    with pytest.raises(FileNotFoundError, match="no folder"):
        train_features(tmp_path / "absent", tmp_path / "weights.npz", shape=TINY)
    with pytest.raises(ValueError, match="no pictures"):
        folder_pictures(tmp_path)


def test_bundled_weights_are_scaled_like_the_random_ones() -> None:
    network = load_network("trained")
    assert network.channels == random_network("compact").channels
    assert "CC0" in network.licence
    assert_equally_loud(network, tolerance=0.01)
