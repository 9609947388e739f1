"""Detail gets the strength that a photo shows."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from jaxface.stages.texture.octaves import octave_bands, with_photos_octaves

SIDE = 128


def grain(strength: float, seed: int) -> jnp.ndarray:
    noise = np.random.default_rng(seed).standard_normal((SIDE, SIDE, 1))
    return jnp.asarray(np.broadcast_to(0.5 + strength * noise, (SIDE, SIDE, 3)), jnp.float32)


def test_bands_sum_to_what_the_last_blur_takes_away():
    image = grain(0.1, 0)[..., 0]
    bands = np.asarray(octave_bands(image))
    assert bands.shape == (4, SIDE, SIDE)
    away = np.asarray(image, float) - float(image.mean())
    expected = away - gaussian_filter(away, 0.26 * 4 * 2**3, mode="constant", truncate=6)
    # The spectrum's period is 16 texels longer than the image: its rims know of each other.
    inner = slice(24, -24), slice(24, -24)
    np.testing.assert_allclose(bands.sum(axis=0)[inner], expected[inner], atol=1e-5)
    assert np.abs(expected[inner]).max() > 0.2


@pytest.mark.parametrize(("band", "wavelength"), [(0, 3), (1, 6), (2, 12), (3, 24)])
def test_a_wave_is_strongest_in_the_band_of_its_octave(band, wavelength):
    wave = np.sin(2 * np.pi * np.arange(SIDE) / wavelength)[None].repeat(SIDE, 0)
    bands = np.asarray(octave_bands(jnp.asarray(wave, jnp.float32)))
    assert bands[:, 40:88, 40:88].std(axis=(1, 2)).argmax() == band


@pytest.mark.parametrize("factor", [0.8, 1.0, 1.6])
def test_hidden_detail_is_as_strong_as_seen_detail(factor):
    texture, photo = grain(0.03, 1), grain(0.03 * factor, 2)
    weight = jnp.asarray((np.arange(SIDE) < 64)[None].repeat(SIDE, 0), jnp.float32)
    found = np.asarray(with_photos_octaves(texture, photo, weight, 1.0))[..., 0]
    before = np.asarray(texture)[..., 0]
    for columns in (slice(10, 50), slice(80, 120)):
        inner = slice(20, 108), columns
        assert found[inner].std() / before[inner].std() == pytest.approx(factor, rel=0.06)


def test_what_the_photo_does_not_resolve_stays():
    texture, blurred = grain(0.03, 3), grain(0.0, 0)
    found = with_photos_octaves(texture, blurred, jnp.ones((SIDE, SIDE)), 40.0)
    np.testing.assert_allclose(found, texture, atol=1e-6)
    unseen = with_photos_octaves(texture, blurred, jnp.zeros((SIDE, SIDE)), 1.0)
    np.testing.assert_allclose(unseen, texture, atol=1e-3)
