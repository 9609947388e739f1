"""Gram matrices behind a mask from the cache: as computed directly; the cache mends itself."""

from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxface.energies._gram import grams, mask_out
from jaxface.io.texture_database import Subject, TextureDatabase
from jaxface.networks.texture_features.random_weights import random_network
from jaxface.pipeline.databases.grams import (
    bytes_to_precompute,
    find_precomputed,
    intensity,
    masked_grams,
    precompute,
)
from jaxface.stages.texture.masked_grams import compressed, layout, masked_grams_of, prepare, store

LAYERS = ("conv1_1", "conv2_1", "conv2_2", "conv3_1")
TOLERANCE = 3e-5  # of 16-bit steps; 2e-5 is reached where one cell's sum is all there is
SHAPE = ((2, 8), (2, 16), (1, 16))
direct = jax.jit(
    lambda network, image, visible: grams(mask_out(image, visible), network, layers=LAYERS)
)


def masks(height: int, width: int) -> dict[str, np.ndarray]:
    y, x = np.mgrid[:height, :width]
    disc = (y - height / 2) ** 2 + (x - width / 2) ** 2 < (width / 3) ** 2
    one = np.zeros((height, width), bool)
    one[height // 2, width // 3] = True
    return {
        "all": np.ones((height, width), bool),
        "none": np.zeros((height, width), bool),
        "one": one,
        "disc": disc,
        "hole": ~disc,
        "border": x < width // 2,
        "corner": (y > height // 2) & (x > width // 3),
    }


@pytest.mark.parametrize("pooling", ["average", "max"])
@pytest.mark.parametrize("cell", [0, 4])
@pytest.mark.parametrize("shape", [(64, 48), (51, 61)])
def test_as_computed_directly(pooling, cell, shape):
    network = random_network(SHAPE, seed=3, pooling=pooling)
    image = jnp.asarray(np.random.default_rng(0).random(shape), jnp.float32)
    plan = layout(network, shape, LAYERS, dict.fromkeys(LAYERS, cell))
    stored = compressed(store(network, image, plan), plan)
    for name, visible in masks(*shape).items():
        found = masked_grams_of(prepare(network, visible, plan), stored)
        for layer, value in direct(network, image, jnp.asarray(visible)).items():
            error = np.linalg.norm(found[layer] - value) / np.linalg.norm(value)
            assert error < TOLERANCE, (name, layer, error)


class Textures:
    """What `precompute` uses of a database."""

    resolution = 64
    names = ("a", "b")

    def __init__(self, path):
        self.path, self.reads = path, []
        self.subjects = [Subject(name, f"{name}.png", "CC0-1.0") for name in self.names]
        self._subjects = {subject.name: subject for subject in self.subjects}
        for subject in self.subjects:
            (path / subject.file).write_bytes(b"texture")

    stamp = TextureDatabase.stamp

    def __len__(self):
        return len(self.names)

    def encoded(self, name):
        self.reads.append(name)
        return np.random.default_rng(ord(name)).random((64, 64, 3)).astype(np.float32)


def test_cache_is_resumed_and_mended(tmp_path):
    network = random_network(SHAPE, seed=3)
    database = cast(Any, Textures(tmp_path))
    told = []
    cache = precompute(
        database, network, 32, lambda done, of: told.append((done, of)), layers=LAYERS
    )
    assert told == [(1, 2), (2, 2)]
    files = [cache.files.file(key) for key in cache.keys]
    stamps = [file.stat().st_mtime_ns for file in files]
    assert files[0].stat().st_size == cache.files.bytes_per_texture

    content = bytearray(files[1].read_bytes())
    content[200] ^= 255
    files[1].write_bytes(content)
    damaged = files[1].read_bytes()
    again = precompute(database, network, 32, layers=LAYERS)
    assert again.keys == cache.keys
    assert files[0].stat().st_mtime_ns == stamps[0]
    assert files[1].read_bytes() != damaged

    files[0].write_bytes(b"short")
    with pytest.raises(ValueError, match="damaged"):
        cache.files.read(cache.keys[0])
    cache = precompute(database, network, 32, layers=LAYERS)
    visible = masks(32, 32)["disc"]
    found = masked_grams(cache, visible)
    for index, name in enumerate(database.names):
        image = jnp.asarray(intensity(database.encoded(name), 32))
        for layer, value in direct(network, image, jnp.asarray(visible)).items():
            error = np.linalg.norm(found[layer][index] - value) / np.linalg.norm(value)
            assert error < TOLERANCE, (layer, error)
    other = precompute(database, random_network(SHAPE, seed=4), 32, layers=LAYERS)
    assert not set(other.keys) & set(cache.keys)


def test_only_what_changed_is_read_again(tmp_path):
    network = random_network(SHAPE, seed=3)
    database = Textures(tmp_path)
    known = cast(Any, database)
    assert find_precomputed(known, network, 32, layers=LAYERS) is None
    cache = precompute(known, network, 32, layers=LAYERS)
    size = bytes_to_precompute(known, network, 32, LAYERS)
    assert size == sum(cache.files.file(key).stat().st_size for key in cache.keys)
    database.reads.clear()
    found = find_precomputed(known, network, 32, layers=LAYERS)
    assert found is not None and found.keys == cache.keys
    assert find_precomputed(known, network, 64, layers=LAYERS) is None
    precompute(known, network, 32, layers=LAYERS)
    assert not database.reads
    (tmp_path / "a.png").write_bytes(b"another texture")
    assert find_precomputed(known, network, 32, layers=LAYERS) is None
    precompute(known, network, 32, layers=LAYERS)
    assert database.reads == ["a"]


def test_older_files_make_room(tmp_path):
    database = cast(Any, Textures(tmp_path))
    first = precompute(database, random_network(SHAPE, seed=3), 32, layers=LAYERS)
    room = 3 * first.files.bytes_per_texture
    second = precompute(
        database, random_network(SHAPE, seed=4), 32, layers=LAYERS, maximum_bytes=room
    )
    assert all(second.files.is_whole(key) for key in second.keys)
    assert [first.files.is_whole(key) for key in first.keys] == [False, True]


def test_one_mask_after_another_in_one_workspace():
    """Rows of an earlier texture must not show in a later one."""
    network = random_network(SHAPE, seed=3)
    plan = layout(network, (64, 48), LAYERS)
    visible = masks(64, 48)["disc"]
    prepared = prepare(network, visible, plan)
    for seed in (1, 2, 1):
        image = jnp.asarray(np.random.default_rng(seed).random((64, 48)), jnp.float32)
        found = masked_grams_of(prepared, compressed(store(network, image, plan), plan))
        for layer, value in direct(network, image, jnp.asarray(visible)).items():
            error = np.linalg.norm(found[layer] - value) / np.linalg.norm(value)
            assert error < TOLERANCE, (seed, layer, error)


def test_bad_arguments_are_named(tmp_path):
    network = random_network(SHAPE, seed=3)
    database = cast(Any, Textures(tmp_path))
    with pytest.raises(ValueError, match="resolution is 48"):
        precompute(database, network, 48, layers=LAYERS)
    with pytest.raises(ValueError, match="would hold"):
        precompute(database, network, 32, layers=LAYERS, maximum_bytes=10)
    plan = layout(network, (32, 32), LAYERS)
    with pytest.raises(ValueError, match="mask has shape"):
        prepare(network, np.ones((16, 16), bool), plan)
