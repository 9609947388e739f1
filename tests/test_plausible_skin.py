"""What is taken out of a partial albedo, and the rims of eyes and mouth."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxface.io.face_models import load_model
from jaxface.models.opening_rims import opening_rims
from jaxface.stages.texture._plausible_skin import SPARKLE, TINT, TONE, plausible_skin
from jaxface.stages.texture.detail import without_marks

SIDE = 256
ROWS, COLUMNS = np.mgrid[:SIDE, :SIDE] + 0.5


def disc(row: float, column: float, radius: float) -> np.ndarray:
    """1 within a disc with a rim of one texel."""
    return np.clip(radius + 0.5 - np.hypot(ROWS - row, COLUMNS - column), 0, 1)[..., None]


SKIN = np.broadcast_to(np.array([0.45, 0.28, 0.2]), (SIDE, SIDE, 3))
PLAIN = np.zeros((SIDE, SIDE), np.float32)


def cleaned(albedo, dark=PLAIN, weight=None):
    weight = np.ones((SIDE, SIDE), np.float32) if weight is None else weight
    found = plausible_skin(*(jnp.asarray(x, jnp.float32) for x in (albedo, weight, SKIN, dark)))
    return tuple(np.asarray(x) for x in found)


def log_ratio(albedo):
    return np.log(albedo / SKIN).mean(-1)


def test_plain_skin_and_its_pores_stay():
    pores = 1 - 0.15 * (np.random.default_rng(0).uniform(size=(SIDE, SIDE, 1)) > 0.9)
    albedo, weight = cleaned(SKIN * pores)
    change = log_ratio(albedo) - np.log(pores[..., 0])
    assert np.abs(change).mean() < 0.005 and np.abs(change).max() < 0.09  # 0.0030, 0.057 measured
    np.testing.assert_allclose(weight, 1, atol=1e-6)


def test_gloss_and_folds_are_bounded_and_hair_is_not_trusted():
    gloss, fold, hair = disc(60, 60, 4), disc(60, 190, 4), disc(190, 128, 5)
    albedo = SKIN * np.exp(0.5 * gloss - 0.4 * fold - 2.0 * hair) + 0.1 * gloss
    found, weight = cleaned(albedo)
    before, after = log_ratio(albedo), log_ratio(found)
    # What is promised is the bound; the surroundings, which are not bounded, add some hundredths.
    assert before[60, 60] > 0.6 and 0 < after[60, 60] < 1.1 * TONE  # 0.98 TONE measured
    assert after[50:70, 50:70].max() < TONE + SPARKLE  # 0.153
    assert before[60, 190] < -0.35 and -1.1 * TONE < after[60, 190] < 0  # -1.05 TONE
    assert weight[190, 128] < 1e-3 and weight[128, 128] > 0.999
    # The highlight has lost its whiteness, too.
    white = np.log(found[60, 60] / SKIN[60, 60])
    assert np.log(albedo[60, 60] / SKIN[60, 60]) @ [-1, 0, 1] > 0.13
    assert white @ [-1, 0, 1] < 2 * TINT  # 0.062
    np.testing.assert_allclose(after[120:136, 200:216], 0, atol=1e-4)  # nothing was there


def test_long_dark_lines_are_bounded_and_moles_are_not():
    line = np.exp(-0.5 * ((ROWS - 128 - 0.3 * COLUMNS) / 0.7) ** 2)[..., None]
    mole = disc(60, 128, 1)
    albedo = SKIN * np.exp(-0.15 * line - 0.15 * mole)
    found, weight = cleaned(albedo)
    place = (int(128 + 0.3 * 100), 100)
    assert log_ratio(albedo)[place] < -0.12 and log_ratio(found)[place] > -0.08
    assert log_ratio(found)[60, 128] < 0.85 * log_ratio(albedo)[60, 128]  # 0.91 measured
    kept, _ = cleaned(albedo, dark=np.full_like(PLAIN, 0.3))
    np.testing.assert_allclose(log_ratio(kept), log_ratio(albedo), atol=1e-4)
    assert weight.min() > 0.999


def test_what_may_be_dark_stays_dark():
    brow = disc(128, 128, 6)
    albedo = SKIN * np.exp(-0.8 * brow)
    kept, weight = cleaned(albedo, dark=10 * brow[..., 0])
    lost, _ = cleaned(albedo)
    np.testing.assert_allclose(log_ratio(kept)[128, 128], -0.8, atol=0.01)  # -0.803 measured
    assert weight[128, 128] > 0.999
    assert -1.2 * TONE < log_ratio(lost)[128, 128] < 0  # -1.1 TONE


def test_nothing_is_read_where_nothing_is_seen():
    weight = (COLUMNS < 128).astype(np.float32)
    albedo = np.where(weight[..., None] > 0, SKIN, 0.0)
    found, trusted = cleaned(albedo, weight=weight)
    np.testing.assert_allclose(found[:, :128], SKIN[:, :128], rtol=1e-5)
    assert trusted[:, 129:].max() == 0 and np.isfinite(found).all()
    skin, dark = jnp.asarray(SKIN, jnp.float32), jnp.asarray(PLAIN)
    slope = jax.grad(lambda x: plausible_skin(x, jnp.asarray(weight), skin, dark)[0].sum())(skin)
    assert np.isfinite(np.asarray(slope)).all()


def test_moles_go_and_freckles_stay():
    rng = np.random.default_rng(1)
    grain = np.exp(0.02 * rng.standard_normal((SIDE, SIDE, 1)))
    mole = disc(100, 100, 1.5)
    places = rng.uniform(170, 250, (300, 2))
    dots = np.sum([disc(row, column, 0.8) for row, column in places], axis=0)
    texture = np.clip(0.6 * grain * np.exp(-0.6 * mole - 0.3 * np.minimum(dots, 1)), 0, 1)
    texture = jnp.asarray(np.repeat(texture, 3, axis=2), jnp.float32)
    everywhere = jnp.ones((SIDE, SIDE))
    found = np.asarray(without_marks(texture, everywhere, 5.0))
    texture = np.asarray(texture)
    assert texture[99:101, 99:101].mean() < 0.34
    assert 0.57 < found[99:101, 99:101].mean() < 0.61  # 0.579 measured, of skin of 0.6
    freckled = slice(190, 230), slice(190, 230)
    assert found[freckled].std() > 0.96 * texture[freckled].std()  # 0.982 measured
    held = np.asarray(without_marks(jnp.asarray(texture), 0 * everywhere, 5.0))
    np.testing.assert_allclose(held, texture, atol=1e-5)


def test_pockets_of_the_lids_and_rims_of_the_lips_are_calm():
    model = load_model("makehuman")
    rims = opening_rims(model)
    before = np.asarray(model.albedo_mean)
    after = np.asarray(rims.calm(model.albedo_mean))
    lids, cheeks = (np.asarray(model.region_mask(name)) for name in ("eyelids", "cheeks"))
    assert (before[lids, 0] / before[lids, 1]).max() > 4
    assert (after[lids, 0] / after[lids, 1]).max() < 3
    np.testing.assert_allclose(after[cheeks], before[cheeks], atol=1e-6)
    assert 0.02 < np.asarray(rims.pocket)[lids].mean() < 0.5
    bare = dataclasses.replace(model, region_names=(), region=jnp.zeros_like(model.region))
    np.testing.assert_allclose(opening_rims(bare).calm(bare.albedo_mean), before, atol=1e-6)
