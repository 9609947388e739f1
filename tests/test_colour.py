"""The sRGB curve, luminance and YIQ: values, inverses and derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from skimage.color import rgb2yiq

from jaxface.imaging.colour import (
    linear_to_srgb,
    luminance,
    rgb_to_yiq,
    srgb_to_linear,
    yiq_to_rgb,
)


def test_known_values():
    # From the standard: the knee, mid-grey, and both ends.
    encoded = np.array([0.0, 0.04045, 0.5, 1.0])
    linear = np.array([0.0, 0.04045 / 12.92, 0.21404114, 1.0])
    np.testing.assert_allclose(srgb_to_linear(encoded), linear, rtol=1e-5)
    np.testing.assert_allclose(linear_to_srgb(linear), encoded, rtol=1e-5)


@given(st.floats(-4, 4, width=32))
def test_each_curve_undoes_the_other(value):
    np.testing.assert_allclose(linear_to_srgb(srgb_to_linear(value)), value, atol=2e-5)
    np.testing.assert_allclose(srgb_to_linear(linear_to_srgb(value)), value, atol=5e-5)


@pytest.mark.parametrize("curve", [srgb_to_linear, linear_to_srgb])
def test_curves_rise_and_are_odd(curve):
    x = jnp.linspace(-2, 2, 4001)
    assert jnp.all(jnp.diff(curve(x)) > 0)
    np.testing.assert_allclose(curve(-x), -curve(x), atol=1e-6)


@pytest.mark.parametrize("curve", [srgb_to_linear, linear_to_srgb])
@pytest.mark.parametrize("value", [-1e30, -0.5, -1e-30, 0.0, 1e-30, 0.002, 0.02, 0.3, 1.0, 50.0])
def test_derivatives_are_finite_and_right(curve, value, x64):
    reverse = jax.grad(curve)(value)
    forward = jax.jvp(curve, (value,), (1.0,))[1]
    assert np.isfinite(reverse)
    np.testing.assert_allclose(forward, reverse, rtol=1e-12)
    step = 1e-6 * max(abs(value), 1e-6)
    numeric = (curve(value + step) - curve(value - step)) / (2 * step)
    np.testing.assert_allclose(reverse, numeric, rtol=1e-5)


def test_yiq_against_scikit_image():
    rgb = np.random.default_rng(0).random((5, 7, 3))
    np.testing.assert_allclose(rgb_to_yiq(jnp.asarray(rgb)), rgb2yiq(rgb), atol=1e-6)
    np.testing.assert_allclose(yiq_to_rgb(rgb_to_yiq(jnp.asarray(rgb))), rgb, atol=1e-5)


def test_grey_has_no_chroma_and_its_own_luminance():
    grey = jnp.full((4, 3), 0.3)
    np.testing.assert_allclose(rgb_to_yiq(grey), [[0.3, 0, 0]] * 4, atol=1e-6)
    np.testing.assert_allclose(luminance(grey), 0.3, atol=1e-6)
