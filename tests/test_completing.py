"""Completing an albedo, from a partial one to files, with small networks and maps."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from jaxface.energies import grams
from jaxface.geometry.uv import uv_layout
from jaxface.imaging.colour import rgb_to_yiq, srgb_to_linear
from jaxface.imaging.resample import block_means
from jaxface.io.face_models import load_model
from jaxface.io.texture_database import TextureDatabase
from jaxface.models.skin.regions import skin_fields
from jaxface.networks.texture_features.random_weights import random_network
from jaxface.pipeline.databases.grams import precompute
from jaxface.pipeline.databases.usual import open_database
from jaxface.pipeline.texture._complete import complete
from jaxface.pipeline.texture.folder import _Levels
from jaxface.pipeline.texture.options import CompletionOptions
from jaxface.pipeline.texture.records import Level
from jaxface.pipeline.texture.seen import SeenTexture, read_seen_texture, seen_texture
from jaxface.stages.texture.composition import OUTLINE, faded
from jaxface.stages.texture.resolutions import level_steps

SIZE = 256
LAYERS = ("conv1_1", "conv2_1", "conv3_1")


@pytest.fixture(scope="module")
def model():
    return load_model("makehuman")


@pytest.fixture(scope="module")
def base(model):
    layout = uv_layout(model.uv, model.uv_faces, SIZE)
    return np.asarray(layout(model.albedo_mean, model.faces, fill=0.3)).clip(0.02, 0.9)


def weighted(seen: SeenTexture, weight: np.ndarray) -> SeenTexture:
    photo = seen.maps["photo"]._replace(weight=weight)
    return dataclasses.replace(seen, maps=seen.maps.with_maps(photo=photo))


def speckled(base, strength, seed):
    rng = np.random.default_rng(seed)
    return base * (1 - strength * (rng.uniform(size=(SIZE, SIZE, 1)) > 0.8))


@pytest.fixture(scope="module")
def database(tmp_path_factory, model, base):
    made = TextureDatabase.create(
        tmp_path_factory.mktemp("db"), model, SIZE, name="speckles", licence="CC0-1.0"
    )
    for index, strength in enumerate((0.02, 0.15, 0.3)):
        made.write_subject(f"s{index}", speckled(base, strength, index))
    return made


@pytest.fixture(scope="module")
def seen(model, base):
    """The left half of a face with speckles of the middle strength."""
    weight = np.zeros((SIZE, SIZE), np.float32)
    weight[:, : SIZE // 2] = 1
    coefficients = np.zeros(model.albedo.count, np.float32)
    return seen_texture(model, speckled(base, 0.15, 9), weight, coefficients, 1.0)


@pytest.fixture(scope="module")
def network():
    return random_network(((1, 8), (1, 16), (1, 16)), seed=1)


SETTINGS = CompletionOptions(iterations=12, layers=LAYERS)


@pytest.fixture(scope="module")
def completed(seen, database, network):
    told = []
    done = complete(
        seen, database, network, SETTINGS,
        on_progress=lambda what, i, n, picture: told.append((what, i, n)),
    )  # fmt: skip
    return done, told


def test_the_right_subject_is_found(completed):
    weights = completed[0].blended.weights
    assert weights.sum() == pytest.approx(1, abs=1e-5)
    assert weights.argmax() == 1
    assert float(completed[0].blended.relative_gap) < 1e-6


def test_progress_is_told(completed):
    _, told = completed
    assert ("analysis", 3, 3) in told
    assert any(what == "synthesis at 256" for what, _, _ in told)


def test_the_unseen_half_gets_detail_and_the_seen_one_keeps_its_own(completed, seen):
    albedo, free = completed[0].albedo, seen["free"]

    def grain(texture, where):
        fine = texture.mean(-1) - np.roll(texture.mean(-1), 1, axis=0)
        return fine[where].std()

    left, right = free.copy(), free.copy()
    left[:, SIZE // 2 :] = False
    right[:, : SIZE // 2] = False
    assert grain(albedo, right) > 2 * grain(seen["low_frequency"], right)
    assert 0.5 < grain(albedo, right) / grain(seen["photo"], left) < 2
    assert np.abs(albedo[left] - seen["photo"][left]).mean() < 0.03
    assert np.isfinite(albedo).all() and albedo.min() >= 0 and albedo.max() <= 1


def test_hidden_detail_is_as_strong_as_what_the_photo_shows(model, base, database, network):
    weight = np.zeros((SIZE, SIZE), np.float32)
    weight[:, : SIZE // 2] = 1
    coarse = seen_texture(
        model, speckled(base, 0.4, 9), weight, np.zeros(model.albedo.count, np.float32), 1.0
    )
    right = coarse["free"].copy()
    right[:, : SIZE // 2 + 8] = False
    left = coarse["free"] & (coarse.weight > 0.99)

    def grain(texture, where):
        fine = texture.mean(-1) - np.roll(texture.mean(-1), 1, axis=0)
        return fine[where].std()

    strength = {}
    for match in (False, True):
        settings = dataclasses.replace(SETTINGS, iterations=1, match_octaves=match)
        found = complete(coarse, database, network, settings).start
        strength[match] = grain(found, right) / grain(coarse["photo"], left)
    assert strength[False] < 0.9
    assert abs(np.log(strength[True])) < 0.5 * abs(np.log(strength[False]))


def test_hair_across_one_brow_is_not_its_own(model, base):
    """Both brows may be dark; one alone may be a little darker than the other."""
    layout = uv_layout(model.uv, model.uv_faces, SIZE)
    brow = np.asarray(layout(skin_fields(model).regions.brow[:, None], model.faces, 0.0))[..., 0]
    wide = np.clip(3 * gaussian_filter(brow, 2), 0, 1)
    right = np.arange(SIZE) > SIZE // 2
    plain, weight = np.zeros(model.albedo.count, np.float32), np.float32(layout.inside)

    def darkness(where):
        albedo = base * np.exp(-0.7 * (wide * where))[..., None]
        photo = srgb_to_linear(seen_texture(model, albedo, weight, plain, 1.0)["photo"])
        middle = (wide > 0.9) & right
        return -np.log(np.asarray(photo)[middle] / base[middle]).mean()

    both, one = darkness(np.ones(SIZE)), darkness(right)
    assert both > 0.5
    assert 0.05 < one < 0.6 * both


def test_eyes_and_mouth_are_left_alone(completed, seen):
    apart = seen["inside"] & ~seen["skin"]
    assert apart.sum() > 100
    np.testing.assert_allclose(completed[0].albedo[apart], seen["low_frequency"][apart], atol=0.02)


def test_finished_levels_are_not_made_again(seen, database, network):
    kept = {}
    first = complete(seen, database, network, SETTINGS, finished=kept.__setitem__)
    told = []
    again = complete(
        seen, database, network, SETTINGS, resumed=kept.get,
        on_progress=lambda what, done, of, picture: told.append(what),
    )  # fmt: skip
    assert kept and not [what for what in told if what.startswith("synthesis")]
    np.testing.assert_allclose(again.albedo, first.albedo, atol=1e-6)
    assert again.levels == first.levels


def test_a_finished_level_is_that_of_its_inputs_alone(seen, database, network, model, tmp_path):
    def kept(options=SETTINGS, network=network, textures=database, seen=seen):
        return _Levels(tmp_path, options, network, textures, seen)

    level = Level(np.ones((4, 4), np.float32), {"conv1_1": np.eye(8)}, {"name": "256 px"})
    kept().write(256, level)
    found = kept().read(256)
    assert found is not None and found.record == level.record
    np.testing.assert_array_equal(found.targets["conv1_1"], level.targets["conv1_1"])

    weights = random_network(((1, 8), (1, 16), (1, 16)), seed=2)  # of the same name
    assert weights.name == network.name
    other = TextureDatabase.create(tmp_path / "db", model, SIZE, name="speckles", licence="CC0-1.0")
    for name in database.names:
        other.write_subject(name, np.full((SIZE, SIZE, 3), 0.5))
    less = weighted(seen, 0.5 * seen.weight)
    steps = dataclasses.replace(SETTINGS, iterations=13)
    for changed in ({"network": weights}, {"textures": other}, {"seen": less}, {"options": steps}):
        assert kept(**changed).read(256) is None, changed
    assert kept().read(128) is None
    next(tmp_path.rglob("*.npz")).write_bytes(b"cut off")
    with pytest.warns(UserWarning, match="no whole checkpoint"):
        assert kept().read(256) is None


def test_detail_can_be_kept_out_of_a_region(seen, completed, database, network):
    settings = dataclasses.replace(
        SETTINGS, detail={"forehead": 0.0}, start="low_frequency", match_complexion=False
    )
    plain = complete(seen, database, network, settings).albedo
    forehead = seen.detail_map({"forehead": 0.0}) == 0
    forehead &= seen["free"]
    forehead[:, : SIZE // 2 + 8] = False
    change = np.abs(plain - seen["low_frequency"]).mean(-1)
    other = seen["free"] & (seen.detail_map({"forehead": 0.0}) == 1)
    other[:, : SIZE // 2 + 8] = False
    assert change[forehead].mean() < 0.5 * change[other].mean()


def test_wrong_input_is_named(seen, database, network, model, tmp_path):
    lone = TextureDatabase.create(tmp_path / "lone", model, SIZE, name="one", licence="x")
    with pytest.raises(ValueError, match="0 subjects; 2 are needed"):
        complete(seen, lone, network, SETTINGS)
    blind = weighted(seen, np.zeros_like(seen.weight))
    with pytest.raises(ValueError, match="no skin"):
        complete(blind, database, network, SETTINGS)
    with pytest.raises(ValueError, match="no region 'beak'"):
        seen.detail_map({"beak": 1.0})
    told = []
    with pytest.raises(ValueError, match="no region 'beak'"):
        complete(
            seen, database, network, dataclasses.replace(SETTINGS, detail={"beak": 1.0}),
            on_progress=lambda *step: told.append(step),
        )  # fmt: skip
    assert not told
    with pytest.raises(ValueError, match="square"):
        seen_texture(model, np.zeros((300, 200, 3)), np.zeros((300, 200)), np.zeros(11), 1.0)
    with pytest.raises(FileNotFoundError, match="jaxface digitize"):
        read_seen_texture(tmp_path)
    with pytest.raises(ValueError, match="name a database"):
        open_database(None, dataclasses.replace(model, name="other"), SIZE)


def test_steps_halve_and_sum():
    assert level_steps(700, 3) == [400, 200, 100]
    assert min(level_steps(1, 4)) == 1


def test_shrink_averages_blocks():
    texture = np.arange(16.0).reshape(4, 4, 1)
    np.testing.assert_allclose(block_means(texture, 2)[..., 0], [[2.5, 4.5], [10.5, 12.5]])
    assert block_means(texture, 8).shape == (4, 4, 1)


def test_blotches_fade_slowly_at_the_outline_pores_soon_and_the_complexion_stays():
    level = 480
    y, x = np.mgrid[:200, :180]
    radius, opening = np.hypot(y - 100, x - 90), np.hypot(y - 80, x - 90)
    free = (radius < 80) & (opening >= 12)
    narrow, wide = level // 128 + 2, level // OUTLINE

    def kept(pattern, where):
        found = np.asarray(faded(jnp.asarray(pattern), free, level))
        assert np.all(found[~free] == 0)
        strong = where & (np.abs(pattern) > 0.7)
        return np.mean(found[strong] / pattern[strong])

    inside = free & (radius < 65) & (opening > 25)
    outline = free & (radius > 79 - wide / 2)
    beside_outline = free & (radius < 79 - narrow) & (radius > 79 - wide)
    blotches = np.sin(2 * np.pi * x / 28) * np.sin(2 * np.pi * y / 28)
    assert kept(blotches, inside) > 0.9
    assert kept(blotches, outline) < 0.5
    pores = np.where((y + x) % 2 == 0, 1.0, -1.0)
    assert kept(pores, inside) > 0.98 and kept(pores, beside_outline) > 0.9
    complexion = np.cos(2 * np.pi * (x - 90) / 400)
    assert abs(kept(complexion, inside & (radius < 50))) < 0.1


def test_as_published_is_the_paper(model, base, database, network):
    """Section 5 at one resolution over the whole map, from the model's albedo as it is."""
    weight = np.zeros((SIZE, SIZE), np.float32)
    weight[:, : SIZE // 2] = 1
    coefficients = np.full(model.albedo.count, 0.5, np.float32)
    partial = speckled(base, 0.15, 9)
    shown = seen_texture(
        model, partial, weight, coefficients, 1.0, plausible=False, whole=True
    )  # fmt: skip
    layout = uv_layout(model.uv, model.uv_faces, SIZE)
    inside = np.asarray(layout.inside)
    low = np.asarray(layout(model.reflectance(jnp.asarray(coefficients)), model.faces))
    np.testing.assert_allclose(
        srgb_to_linear(shown["low_frequency"])[inside], low[inside], atol=1e-4
    )
    np.testing.assert_allclose(srgb_to_linear(shown["photo"]), partial, atol=1e-4)
    np.testing.assert_array_equal(shown.weight, weight)
    assert shown["free"].all()

    options = dataclasses.replace(CompletionOptions.as_published(), iterations=8, layers=LAYERS)
    done = complete(shown, database, network, options)
    assert done.compared_by == "network" and done.analysed_at == SIZE
    assert done.box == (slice(0, SIZE), slice(0, SIZE)) and len(done.levels) == 1
    np.testing.assert_allclose(done.start, shown["low_frequency"], atol=1e-5)
    # The target is the convex blend of the subjects' own Gram matrices, eq. 2.
    own = [
        grams(rgb_to_yiq(jnp.asarray(texture))[..., 0], network, layers=LAYERS)
        for texture in database
    ]
    for name in LAYERS:
        blended = sum(w * g[name] for w, g in zip(done.blended.weights, own, strict=True))
        np.testing.assert_allclose(done.targets[name], blended, rtol=2e-3, atol=1e-5)
    # I and Q stay those of the low-frequency albedo.
    found, first = (np.asarray(rgb_to_yiq(jnp.asarray(x))) for x in (done.albedo, done.start))
    unclipped = inside & (done.albedo > 0.01).all(-1) & (done.albedo < 0.99).all(-1)
    assert unclipped.mean() > 0.2
    np.testing.assert_allclose(found[unclipped][:, 1:], first[unclipped][:, 1:], atol=2e-3)
    values = done.levels[0]["values"]
    assert values[-1] < 0.5 * values[0]

    precompute(database, network, SIZE, layers=LAYERS)
    again = complete(shown, database, network, dataclasses.replace(options, iterations=1))
    assert again.compared_by == "cache"
    np.testing.assert_allclose(again.blended.weights, done.blended.weights, atol=2e-3)
