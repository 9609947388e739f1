"""Which of several photos were taken under one light, and the photos without their gloss."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxface.imaging.crop import Crop
from jaxface.render.shading import sh_basis
from jaxface.stages._common_light import LitVertices, shared_light
from jaxface.stages.texture.specularity import lips, without_specularity


def photos(lights):
    """One noisy photo of another albedo under each light, and the model's mean and basis."""
    rng = np.random.default_rng(5)
    mean = rng.uniform(0.2, 0.5, (300, 3))
    basis = 0.03 * rng.normal(size=(300, 3, 2))
    seen = []
    for light in lights:
        normal = rng.normal(size=(300, 3)) + [0, 0, 1.5]
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        harmonics = np.asarray(sh_basis(jnp.asarray(normal)))
        colour = (mean + basis @ rng.normal(size=2)) * (harmonics @ light)
        colour = colour * (1 + 0.1 * rng.normal(size=colour.shape))
        parts = (jnp.asarray(p, jnp.float32) for p in (colour, harmonics, np.ones(300)))
        seen.append(LitVertices(*parts))
    return seen, jnp.asarray(mean, jnp.float32), jnp.asarray(basis, jnp.float32)


def lamp(side: float) -> np.ndarray:
    light = np.zeros((9, 3))
    light[0], light[2], light[3] = [3.0, 2.8, 2.5], 0.6, side
    return light


def test_a_photo_under_another_light_does_not_bend_the_rest():
    true = lamp(0.4)
    seen, mean, basis = photos([true, 2 * true, lamp(-1.6), true, true])
    found = shared_light(seen, mean, basis)
    np.testing.assert_array_equal(found.alike, [True, True, False, True, True])
    assert found.light is not None
    visible = np.asarray(seen[0].harmonics)
    ours = visible @ np.asarray(found.light) * float(found.gains[0])
    assert np.median(np.abs(ours / (visible @ true) - 1)) < 0.02
    assert float(found.gains[1] / found.gains[0]) == pytest.approx(2, rel=0.05)
    assert float(found.misfit[2]) > 1.5 * max(found.own_misfit[2], 0.02)


def test_photos_that_share_no_light_are_told():
    seen, mean, basis = photos([lamp(1.4), lamp(-1.4)])
    found = shared_light(seen, mean, basis)
    assert found.light is None and found.alike.sum() < 2


def test_gloss_is_cut_where_the_mask_shows_skin_and_nowhere_else():
    rng = np.random.default_rng(0)
    size = 96
    shade = 0.6 + 0.3 * np.linspace(0, 1, size)[:, None] + 0.02 * rng.random((size, size))
    diffuse = (shade[..., None] * [0.6, 0.35, 0.25]).astype(np.float32)
    row, column = np.mgrid[:size, :size]
    peak = np.exp(-((row - 40) ** 2 + (column - 30) ** 2) / 30) + np.exp(
        -((row - 40) ** 2 + (column - 80) ** 2) / 30
    )
    glossy = diffuse + (0.5 * peak[..., None]).astype(np.float32)
    crop = Crop(glossy, np.ones((size, size)), np.zeros(2), float(size))
    skin = np.ones((size, size), np.float32)
    skin[:, 56:] = 0
    light = jnp.zeros((9, 3)).at[0].set(1.0)
    found = without_specularity(glossy, crop, skin, light)
    assert found.shape == glossy.shape
    near = (row - 40) ** 2 + (column - 30) ** 2 < 16
    left = np.abs(found - diffuse)[near].mean()
    assert left < 0.25 * np.abs(glossy - diffuse)[near].mean()
    np.testing.assert_allclose(found[:, 58:], glossy[:, 58:], atol=1e-5)


def test_lips_are_their_outline_and_a_little_more():
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    points = np.zeros((68, 2))
    points[48:60] = np.stack([64 + 20 * np.cos(angle), 80 + 8 * np.sin(angle)], axis=1)
    window = lips(points, 128)
    assert window[80, 64] > 0.99 and window[80, 64 + 30] < 0.01 and window[40, 64] == 0
    assert 0 < window[80, 64 + 21] < 1
