"""Bilinear lookup, crops, resizing, pyramids, and windows of photos of any size."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from jaxface.imaging.pyramid import halve, pyramid
from jaxface.imaging.resample import affine_crop, bilinear, pixel_centres, resize
from jaxface.imaging.windows import PhotoPyramid, tile_corners, unturn

RNG = np.random.default_rng(0)
IMAGE = RNG.random((9, 13, 3)).astype(np.float32)


@given(st.floats(-5, 20), st.floats(-5, 20))
def test_bilinear_against_scipy(x, y):
    expected = [
        map_coordinates(IMAGE[..., c], [[y - 0.5], [x - 0.5]], order=1, mode="nearest")[0]
        for c in range(3)
    ]
    np.testing.assert_allclose(bilinear(IMAGE, jnp.array([x, y])), expected, atol=1e-5)


def test_bilinear_at_pixel_centres_is_the_image():
    np.testing.assert_allclose(bilinear(jnp.asarray(IMAGE), pixel_centres(9, 13)), IMAGE)
    np.testing.assert_allclose(bilinear(jnp.ones((1, 1, 2)), jnp.array([[7.0, -3.0]])), 1.0)


def test_bilinear_derivatives(x64):
    image = jnp.asarray(IMAGE, jnp.float64)
    points = jnp.asarray(RNG.random((40, 2)) * [11, 7] + 1.013)
    weights = jnp.asarray(RNG.random((40, 3)))

    def value(image, points):
        return jnp.sum(bilinear(image, points) ** 2 * weights)

    tangents = (jnp.asarray(RNG.normal(size=image.shape)), jnp.asarray(RNG.normal(size=(40, 2))))
    step = 1e-6
    moved = [
        value(image + s * step * tangents[0], points + s * step * tangents[1]) for s in (1, -1)
    ]
    numeric = (moved[0] - moved[1]) / (2 * step)
    _, forward = jax.jvp(value, (image, points), tangents)
    gradients = jax.grad(value, argnums=(0, 1))(image, points)
    reverse = sum(jnp.vdot(g, t) for g, t in zip(gradients, tangents, strict=True))
    np.testing.assert_allclose(forward, numeric, rtol=1e-6)
    np.testing.assert_allclose(reverse, numeric, rtol=1e-6)


def test_affine_crop_cuts_out_and_turns():
    cut = affine_crop(jnp.asarray(IMAGE), jnp.array([[1.0, 0, 4], [0, 1, 2]]), 3, 5)
    np.testing.assert_allclose(cut, IMAGE[2:5, 4:9], atol=1e-6)
    turned = affine_crop(jnp.asarray(IMAGE), jnp.array([[0.0, -1, 13], [1, 0, 0]]), 13, 9)
    np.testing.assert_allclose(turned, np.rot90(IMAGE), atol=1e-6)


@given(st.integers(2, 40), st.integers(2, 40))
def test_resize_keeps_constants_and_linear_ramps(height, width):
    ramp = pixel_centres(24, 24) / 24
    constant = resize(jnp.full((24, 24, 1), 0.7), height, width)
    np.testing.assert_allclose(constant, 0.7, atol=1e-5)
    inner = np.asarray(resize(ramp, height, width))
    expected = np.asarray(pixel_centres(height, width)) / [width, height]
    # Within one filter's reach of the border the filter is cut off.
    reach = 1.0 / min(height, width, 24) + 1e-6
    away = np.all((expected > reach) & (expected < 1 - reach), axis=-1)
    np.testing.assert_allclose(inner[away], expected[away], atol=1e-2)


def test_resize_removes_what_would_alias():
    stripes = jnp.tile(jnp.array([0.0, 1.0]), 32)[None, :, None] * jnp.ones((64, 1, 1))
    assert np.ptp(np.asarray(resize(stripes, 16, 16))[2:-2, 2:-2]) < 0.01


def test_pyramid_halves_and_places():
    levels = pyramid(jnp.asarray(IMAGE), 3)
    assert [level.shape for level in levels] == [(9, 13, 3), (5, 7, 3), (3, 4, 3)]
    np.testing.assert_allclose(levels[1][1, 2], IMAGE[2:4, 4:6].mean(axis=(0, 1)), atol=1e-6)
    # A ramp keeps its value at halved coordinates.
    ramp = halve(pixel_centres(8, 6))
    np.testing.assert_allclose(ramp, 2 * pixel_centres(4, 3), atol=1e-6)


@pytest.mark.parametrize("levels", [0, 5])
def test_pyramid_refuses_depths_that_are_not_there(levels):
    with pytest.raises(ValueError, match=f"levels is {levels}; an image of 13x9"):
        pyramid(jnp.asarray(IMAGE), levels)


PHOTO = RNG.integers(0, 256, (151, 225, 3), np.uint8)


@pytest.mark.parametrize("photo", [PHOTO, (PHOTO / 255).astype(np.float64)])
@pytest.mark.parametrize("centre", [(-200, 50), (0, 0), (225, 151), (900, -700), (110.4, 75.2)])
@pytest.mark.parametrize(("reach", "factor"), [(30, 1), (60, 2), (130, 4)])
def test_patches_show_the_photo_and_go_on_at_the_border(photo, centre, reach, factor):
    patch, corner, found = PhotoPyramid(photo).patch(centre, reach, 80)
    assert found == factor and patch.shape == (3, 80, 80)
    level = jnp.asarray(PHOTO / 255, jnp.float32)
    for _ in range(int(np.log2(factor))):
        level = halve(level)
    rows = np.clip(int(corner[1]) + np.arange(80), 0, level.shape[0] - 1)
    columns = np.clip(int(corner[0]) + np.arange(80), 0, level.shape[1] - 1)
    expected = np.asarray(level)[rows[:, None], columns]
    np.testing.assert_allclose(np.moveaxis(patch, 0, -1), expected, atol=1e-5)
    # The middle of the patch is the centre to half a pixel of the level.
    assert np.all(np.abs((corner + 40) * factor - centre) <= 0.5 * factor)


def test_pictures_resize_as_resize_does():
    picture = PhotoPyramid(PHOTO).picture((20.0, 10.0), 100.0, 64)
    cut = jnp.asarray(PHOTO[10:110, 20:120] / 255, jnp.float32)
    np.testing.assert_allclose(picture[2:-2, 2:-2], resize(cut, 64, 64)[2:-2, 2:-2], atol=1e-5)


def test_pictures_are_black_outside_the_photo():
    picture = PhotoPyramid(PHOTO).picture((0.0, (151 - 225) / 2), 225.0, 128)
    assert picture.shape == (128, 128, 3)
    border = int((225 - 151) / 2 / 225 * 128)
    assert np.all(picture[: border - 1] == 0) and np.all(picture[-border + 1 :] == 0)
    assert picture[border + 2 : -border - 2].min() > 0


@given(st.integers(16, 900), st.integers(16, 900), st.floats(20, 900), st.floats(0.1, 0.6))
def test_tiles_cover_the_photo_and_overlap(width, height, side, overlap):
    corners = np.array(tile_corners(width, height, side, overlap))
    for axis, length in enumerate((width, height)):
        starts = np.unique(corners[:, axis])
        assert starts[0] <= 1e-9 and starts[-1] + side >= length - 1e-9
        assert np.all(np.diff(starts) <= side * (1 - overlap) + 1e-6)


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_unturn_finds_the_pixel_again(turns):
    picture = RNG.random((6, 6))
    turned = np.rot90(picture, turns)
    x, y = unturn(np.array([1.5, 4.5]), turns, 6)
    assert turned[4, 1] == picture[int(y), int(x)]


@pytest.mark.parametrize(
    ("photo", "message"),
    [
        (np.zeros((20, 20)), "shape"),
        (np.zeros((20, 8, 3), np.uint8), "8x20 px"),
        (np.zeros((20, 20, 3), np.int32), "int32"),
        (np.full((20, 20, 3), np.nan), "NaN"),
    ],
)
def test_arrays_that_are_no_photos_are_refused(photo, message):
    with pytest.raises(ValueError, match=message):
        PhotoPyramid(photo)
