"""The inverse-frequency filter, and the unknown of the synthesis that is built on it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads

from jaxface.imaging.spectrum import inverse_frequency
from jaxface.stages.texture._synthesise import changed


@settings(deadline=None, max_examples=20)
@given(st.integers(8, 33), st.integers(8, 33), st.integers(0, 1000))
def test_symmetric_and_positive(height, width, seed):
    rng = np.random.default_rng(seed)
    one, other = (jnp.asarray(rng.normal(size=(height, width)), jnp.float32) for _ in range(2))
    across = float(jnp.sum(one * inverse_frequency(other)))
    assert across == pytest.approx(float(jnp.sum(other * inverse_frequency(one))), abs=2e-3)
    assert float(jnp.sum(one * inverse_frequency(one))) > 0


def test_white_noise_keeps_its_variance_and_grows_smoother():
    noise = jnp.asarray(np.random.default_rng(0).normal(size=(256, 192)), jnp.float32)
    smooth = np.asarray(inverse_frequency(noise))
    assert smooth.std() == pytest.approx(1.0, rel=0.1)
    assert np.diff(smooth, axis=0).std() < 0.8 * np.diff(np.asarray(noise), axis=0).std()


def test_a_wave_is_scaled_by_its_frequency():
    x = np.arange(128)
    heights = []
    for cycles in (8, 44):
        wave = np.broadcast_to(np.cos(2 * np.pi * cycles * x / 128), (128, 128))
        answer = np.asarray(inverse_frequency(jnp.asarray(wave, jnp.float32)))
        heights.append(np.sum(answer * wave) / np.sum(wave**2))
        np.testing.assert_allclose(answer, heights[-1] * wave, atol=1e-4)
    assert heights[0] / heights[1] == pytest.approx((44 + 8) / (8 + 8), rel=1e-4)


def test_no_change_is_the_start_and_no_detail_keeps_it():
    rng = np.random.default_rng(1)
    start = jnp.asarray(rng.uniform(0.1, 0.9, (24, 24)), jnp.float32)
    change = jnp.asarray(rng.normal(size=(24, 24)), jnp.float32)
    np.testing.assert_allclose(changed(start, jnp.zeros_like(start)), start, atol=1e-6)
    detail = jnp.ones_like(start).at[:12].set(0.0)
    mixed = np.asarray(changed(start, change, detail))
    np.testing.assert_allclose(mixed[:12], start[:12], atol=1e-6)
    assert np.abs(mixed[12:] - np.asarray(start)[12:]).mean() > 0.05
    assert mixed.min() > 0 and mixed.max() < 1


def test_gradient_of_the_unknown_in_both_modes(x64):
    rng = np.random.default_rng(2)
    start, detail = (jnp.asarray(rng.uniform(0.1, 0.9, (8, 6))) for _ in range(2))
    change = jnp.asarray(rng.normal(size=(8, 6)))
    check_grads(lambda c: changed(start, c, detail), (change,), 2, ("fwd", "rev"), eps=1e-6)
    assert jax.grad(lambda c: jnp.sum(changed(start, c, 0.0)))(change).any() == 0
