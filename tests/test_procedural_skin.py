"""Procedural skin: noise and spots on their own, and whole faces."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxface.geometry.uv import seam_edges, uv_layout
from jaxface.imaging.colour import luminance
from jaxface.io.face_models import load_model
from jaxface.models.skin import SkinAttributes, random_attributes, synthesise_skin
from jaxface.models.skin.noise import gradient_noise, mix, visible
from jaxface.models.skin.pigments import Density, absorb
from jaxface.models.skin.regions import skin_fields
from jaxface.models.skin.spots import gather_spots, soft_disc

SEED = jnp.uint32(7)


def grid(side: float, count: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Points of a tilted square of the plane x + y + z = const, ``side`` mm wide."""
    u, v = jnp.meshgrid(jnp.linspace(0, side, count), jnp.linspace(0, side, count))
    u, v = u.ravel(), v.ravel()
    a, b = np.array([1, -1, 0]) / np.sqrt(2), np.array([1, 1, -2]) / np.sqrt(6)
    x, y, z = (jnp.asarray(a[k] * u + b[k] * v + 40.0, jnp.float32) for k in range(3))
    return x, y, z


NORMAL = tuple(jnp.full(1, 1 / np.sqrt(3), jnp.float32) for _ in range(3))


def test_noise_has_unit_power_at_its_wavelength():
    noise = np.asarray(gradient_noise(grid(60.0, 256), 4.0, SEED)).reshape(256, 256)
    assert abs(noise.mean()) < 0.15 and 0.8 < noise.std() < 1.2
    power = np.abs(np.fft.fft2(noise - noise.mean())) ** 2
    f = np.hypot(*np.meshgrid(*[np.fft.fftfreq(256, 60 / 255)] * 2))
    share = power[(f > 1 / 8) & (f < 1 / 2)].sum() / power.sum()
    assert share > 0.8, "power within an octave either side of the wavelength"


@given(st.integers(0, 2**32 - 1))
def test_hash_spreads_single_bits(value):
    """Flipping one input bit flips about half of the output bits."""
    x = jnp.uint32(value)
    flips = [int(mix(x) ^ mix(x ^ jnp.uint32(1 << k))).bit_count() for k in range(0, 32, 5)]
    assert 9 < np.mean(flips) < 23


@pytest.mark.parametrize("cell", [0.7, 3.0])
def test_spots_have_their_density_and_size(cell):
    side, count = 40 * cell, 512
    radius, step = 0.2 * cell, side / (count - 1)
    position = grid(side, count)
    normal = tuple(jnp.broadcast_to(n, position[0].shape) for n in NORMAL)
    cover = gather_spots(
        position, normal, cell, SEED,
        lambda s: (s.on_surface > 0) * (s.distance2 < radius * radius).astype(jnp.float32),
    )  # fmt: skip
    # Poisson-like: 1 - exp(-density * area), one point per cell^2.
    expected = 1 - np.exp(-np.pi * 0.2**2)
    assert abs(float(cover.mean()) - expected) < 0.02
    inside = np.asarray(cover).reshape(count, count)
    widths = np.diff(np.flatnonzero(np.diff(inside[count // 2]) != 0))[::2] * step
    assert widths.size and widths.max() < 4 * radius + step


def test_discs_keep_their_volume_at_any_texel():
    for texel in (0.05, 0.2, 0.5):
        x = np.arange(-3, 3, texel)
        squared = jnp.asarray(x[:, None] ** 2 + x[None] ** 2, jnp.float32)
        volume = float(soft_disc(squared, 0.3, jnp.full(squared.shape, texel)).sum()) * texel**2
        assert volume == pytest.approx(np.pi * 0.3**2 / 3, rel=0.15)


def test_waves_below_two_texels_are_left_out():
    shown = np.asarray(visible(1.0, jnp.array([0.1, 0.25, 0.5, 1.0])))
    np.testing.assert_allclose(shown, [1, 1, 0, 0], atol=1e-6)


def test_pigments_absorb_their_own_colours():
    base = tuple(jnp.full(1, v) for v in (0.6, 0.4, 0.3))
    melanin, blood = absorb(base, Density(0.3)), absorb(base, Density(0.0, 0.3))
    ratio = [np.array([float(b[0] / a[0]) for a, b in zip(base, x, strict=True)])
             for x in (melanin, blood)]  # fmt: skip
    assert ratio[0][0] > ratio[0][1] > ratio[0][2], "melanin absorbs blue most"
    assert ratio[1][0] > ratio[1][2] > ratio[1][1], "blood absorbs green most"
    both = absorb(melanin, Density(0.0, 0.3))
    np.testing.assert_allclose(both, absorb(base, Density(0.3).plus(Density(0.0, 0.3))), rtol=1e-6)


@pytest.fixture(scope="module")
def face():
    model = load_model("makehuman")
    return model, skin_fields(model)


def plain(**traits) -> SkinAttributes:
    attributes = random_attributes(jax.random.key(0))
    defaults = {
        "male": 0.0, "age": 30.0, "melanin": 0.0, "haemoglobin": 0.0, "wrinkles": 0.0,
        "freckles": 0.0, "moles": 0.0, "blemishes": 0.0, "age_spots": 0.0, "stubble": 0.0,
        "mottling": 1.0, "pores": 1.0, "furrows": 1.0, "flush": 1.0, "hair_melanin": 0.8,
    }  # fmt: skip
    values = {k: jnp.asarray(v, jnp.float32) for k, v in {**defaults, **traits}.items()}
    return dataclasses.replace(attributes, **values, tone=jnp.zeros(8))


def paint(face, resolution=128, key=1, **traits):
    model, fields = face
    layout = uv_layout(model.uv, model.uv_faces, resolution)
    return synthesise_skin(model, layout, plain(**traits), jax.random.key(key), fields)


def weight(face, region, resolution=128):
    model, fields = face
    layout = uv_layout(model.uv, model.uv_faces, resolution)
    values = layout(getattr(fields.regions, region)[:, None], model.faces)[..., 0]
    return np.asarray(values * layout.inside)


def test_albedo_is_finite_within_range_and_reproducible(face):
    first, second, other = paint(face), paint(face), paint(face, key=2)
    assert first.shape == (128, 128, 3) and bool(jnp.isfinite(first).all())
    assert float(first.min()) > 0 and float(first.max()) < 1
    np.testing.assert_array_equal(first, second)
    assert float(jnp.abs(first - other).mean()) > 1e-3


def test_attributes_are_a_broad_population():
    drawn = [random_attributes(jax.random.key(k)) for k in range(200)]
    ages = np.array([float(a.age) for a in drawn])
    assert ages.min() >= 18 and ages.max() <= 80 and ages.std() > 10
    assert 0.35 < np.mean([float(a.male) for a in drawn]) < 0.65
    assert all(float(a.stubble) == 0 for a in drawn if a.male == 0)
    melanin = np.array([float(a.melanin) for a in drawn])
    assert melanin.min() < -0.3 and melanin.max() > 1.2
    freckled = np.array([float(a.freckles) for a in drawn])
    assert freckled[melanin > 0.3].max() == 0 < freckled[melanin < 0].mean()
    summary = drawn[0].summary()
    assert isinstance(summary["age"], float) and len(summary["tone"]) == 8


def test_pigments_change_the_whole_face(face):
    cheek = weight(face, "cheek")[..., None]
    colour = [np.sum(np.asarray(paint(face, melanin=m)) * cheek, (0, 1)) for m in (-0.4, 0, 1.4)]
    assert colour[0][1] > 1.25 * colour[1][1] > 2 * colour[2][1]
    blood = np.sum(np.asarray(paint(face, haemoglobin=0.15)) * cheek, (0, 1))
    assert blood[0] / blood[1] > 1.05 * colour[1][0] / colour[1][1]


@pytest.mark.parametrize(
    ("trait", "value", "inside", "outside"),
    [
        ("stubble", 1.0, "beard", "forehead"),
        ("freckles", 0.9, "cheek", "neck"),
        ("wrinkles", 1.0, "forehead", "scalp"),
    ],
)
def test_traits_show_where_they_belong(face, trait, value, inside, outside):
    without, with_it = paint(face), paint(face, **{trait: value})
    change = np.asarray(luminance(jnp.abs(jnp.log(with_it / without))))
    here, there = weight(face, inside), weight(face, outside)
    mean_here, mean_there = (np.sum(change * w) / w.sum() for w in (here, there))
    assert mean_here > 0.004 and mean_here > 4 * mean_there


def test_lips_are_redder_than_cheeks_and_brows_darker(face):
    albedo = np.asarray(paint(face))

    def mean(region):
        w = weight(face, region)
        return np.sum(albedo * w[..., None], (0, 1)) / w.sum()

    lips, cheek, brow, forehead = (mean(r) for r in ("lips", "cheek", "brow", "forehead"))
    assert lips[0] / lips[1] > 1.2 * cheek[0] / cheek[1]
    assert brow.sum() < 0.75 * forehead.sum()


def test_one_subject_at_two_resolutions(face):
    coarse, fine = paint(face), paint(face, 256)
    pooled = fine.reshape(128, 2, 128, 2, 3).mean((1, 3))
    skin = weight(face, "cheek")
    error = np.abs(np.asarray(jnp.log(coarse / pooled))).mean(-1)
    assert np.sum(error * skin) / skin.sum() < 0.012
    # It is the same face: the blotches agree.
    a, b = (np.asarray(jnp.log(x[..., 1]))[skin > 0.5] for x in (coarse, pooled))
    assert np.corrcoef(a, b)[0, 1] > 0.9


def test_no_seams(face):
    """Across every cut of the UV layout the two sides show the same skin."""
    model, _ = face
    size = 256
    albedo = np.asarray(paint(face, size, freckles=0.8, stubble=0.8))
    sides = seam_edges(model.faces, model.uv_faces)
    uv = np.asarray(model.uv)
    region = np.asarray(model.region)
    by_uv = np.zeros(len(uv), int)
    by_uv[np.asarray(model.uv_faces).ravel()] = np.asarray(model.faces).ravel()
    skin = ~np.isin(region, [model.region_names.index(n) for n in ("eyes", "mouth_interior")])

    def at(ends):
        middle = uv[np.asarray(ends)].mean(axis=1) * size
        x, y = middle[:, 0].astype(int), (size - middle[:, 1]).astype(int)
        return albedo[np.clip(y, 0, size - 1), np.clip(x, 0, size - 1)]

    kept = skin[by_uv[np.asarray(sides[0])]].all(axis=1)
    gap = np.abs(np.log(at(sides[0]) / at(sides[1])))[kept]
    assert kept.sum() > 30
    # Texels are up to a millimetre apart there; unrelated skin would differ by over 0.1.
    assert np.median(gap) < 0.05


@pytest.mark.slow
def test_runs_inside_jit(face):
    model, fields = face
    layout = uv_layout(model.uv, model.uv_faces, 64)
    key = jax.random.key(3)
    painted = jax.jit(lambda a: synthesise_skin(model, layout, a, key, fields))(plain())
    np.testing.assert_allclose(
        painted, synthesise_skin(model, layout, plain(), key, fields), atol=1e-5
    )


def test_it_needs_landmarks(face):
    with pytest.raises(ValueError, match="no 68 landmarks"):
        skin_fields(dataclasses.replace(face[0], landmarks68=None))
