"""Drawing over images: where the ink lands, what the colours say, how sheets are laid out."""

import numpy as np
import pytest

from jaxface.io.pictures.colourmap import diverging, sequential
from jaxface.io.pictures.drawing import (
    as_rgb8,
    draw_landmarks,
    draw_points,
    draw_polyline,
    draw_text,
    tint,
)
from jaxface.io.pictures.overlay import contact_sheet, heatmap

BLACK = np.zeros((40, 60, 3), np.uint8)
RED = (255, 0, 0)


@pytest.mark.parametrize(
    ("image", "expected"),
    [
        (np.full((2, 3), 0.5), 128),
        (np.full((2, 3, 1), 7, np.uint8), 7),
        (np.full((2, 3, 3), 0x1234, np.uint16), 0x12),
        (np.ones((2, 3), bool), 255),
        (np.array([[[np.nan, np.inf, -3.0]]]), [0, 255, 0]),
        (np.full((2, 3, 4), 255, np.uint8), 255),
    ],
)
def test_every_kind_of_image_becomes_rgb(image: np.ndarray, expected) -> None:
    out = as_rgb8(image)
    assert out.dtype == np.uint8 and out.shape == (*image.shape[:2], 3)
    np.testing.assert_array_equal(out, np.broadcast_to(expected, out.shape))


@pytest.mark.parametrize("shape", [(3,), (2, 2, 2), (1, 2, 2, 3)])
def test_what_is_no_image_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="shape"):
        as_rgb8(np.zeros(shape))
    with pytest.raises(ValueError, match="dtype"):
        as_rgb8(np.zeros((2, 2), np.int64))


def test_ink_is_centred_on_the_point() -> None:
    rng = np.random.default_rng(1)
    for x, y in rng.uniform(8, 30, (5, 2)):
        ink = draw_points(BLACK, np.array([[x, y]]), RED, 3.0, outline=False)[..., 0].astype(float)
        rows, columns = np.indices(ink.shape) + 0.5
        np.testing.assert_allclose((ink * columns).sum() / ink.sum(), x, atol=0.05)
        np.testing.assert_allclose((ink * rows).sum() / ink.sum(), y, atol=0.05)
        np.testing.assert_allclose(ink.sum() / 255, np.pi * 3.0**2, rtol=0.03)


def test_a_line_has_its_length_and_width() -> None:
    ink = draw_polyline(BLACK, np.array([[10.0, 10.0], [40.0, 30.0]]), RED, 2.0)[..., 0] / 255
    np.testing.assert_allclose(ink.sum(), 2.0 * np.hypot(30, 20) + np.pi, rtol=0.05)
    closed = draw_polyline(BLACK, np.array([[5.0, 5.0], [30.0, 5.0], [30.0, 30.0]]), RED, 2, True)
    assert closed[17, 17, 0] > 100


def test_points_outside_or_not_finite_leave_no_trace() -> None:
    points = np.array([[np.nan, 3.0], [-50.0, 2.0], [1e9, 1e9], [np.inf, 1.0]])
    np.testing.assert_array_equal(draw_points(BLACK, points), BLACK)
    np.testing.assert_array_equal(draw_landmarks(BLACK, np.zeros((0, 2))), BLACK)
    assert draw_points(BLACK, np.array([[0.0, 0.0]])).any()


def test_68_landmarks_are_joined() -> None:
    points = np.stack([np.linspace(5, 55, 68), np.full(68, 20.0)], axis=-1)
    joined = draw_landmarks(BLACK, points, RED, radius=0.5)
    apart = draw_landmarks(BLACK, points[:67], RED, radius=0.5)
    assert (joined[..., 0] > 0).sum() > (apart[..., 0] > 0).sum()


def test_tint_and_text_keep_the_input() -> None:
    image = np.full((40, 60, 3), 100, np.uint8)
    mask = np.zeros((40, 60), bool)
    mask[:, :30] = True
    out = tint(image, mask, RED, 1.0)
    assert (out[:, :30] == RED).all() and (out[:, 30:] == 100).all()
    assert (draw_text(image, (5, 5), "face", 12) != image).any()
    assert (image == 100).all()


def lightness(rgb: np.ndarray) -> np.ndarray:
    """CIE lightness (cube root of luminance) of sRGB."""
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return np.cbrt(linear @ np.array([0.2126, 0.7152, 0.0722]))


def test_sequential_lightness_rises_evenly() -> None:
    steps = np.diff(lightness(sequential(np.linspace(0, 1, 64))))
    assert (steps > 0).all() and steps.max() < 3 * steps.mean()


def test_diverging_is_lightest_and_grey_in_the_middle() -> None:
    colours = diverging(np.linspace(0, 1, 65))
    assert np.argmax(lightness(colours)) == 32
    assert np.ptp(colours[32]) < 0.02
    assert colours[0, 2] > colours[0, 0] and colours[-1, 0] > colours[-1, 2]


def test_heatmap_orders_values_and_leaves_gaps_dark() -> None:
    values = np.tile(np.linspace(0, 10, 60), (40, 1))
    values[:5] = np.nan
    out = heatmap(values, 0, 10, legend=False)
    assert (np.diff(lightness(out[20] / 255)) > -1e-3).all()
    assert (out[:5] == out[0, 0]).all() and out[0, 0].max() < 40
    assert (heatmap(np.full((40, 60), np.nan)) >= 0).all()
    assert (heatmap(values, 0, 10, unit="mm") != out).any()


@pytest.mark.parametrize("count", [1, 2, 5, 6, 7, 9])
def test_sheet_holds_every_panel_at_its_aspect(count: int) -> None:
    greens = [np.full((30 + 5 * i, 50, 3), (0, 200 + i, 0), np.uint8) for i in range(count)]
    sheet = contact_sheet([(f"{i}", g) for i, g in enumerate(greens)], cell=64)
    for i, panel in enumerate(greens):
        found = (sheet == (0, 200 + i, 0)).all(axis=-1)
        height, width = np.ptp(np.argwhere(found), axis=0) + 1
        assert found.sum() == height * width
        np.testing.assert_allclose(height / width, panel.shape[0] / panel.shape[1], atol=0.04)


def test_sheet_without_panels_is_refused() -> None:
    with pytest.raises(ValueError, match="0 panels"):
        contact_sheet([])
