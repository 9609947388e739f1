"""Functions that stay finite, in value and in derivative, everywhere."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax.test_util import check_grads

from jaxface._compilation import quick_jit
from jaxface._numerics import (
    cross,
    running_count,
    safe_divide,
    safe_norm,
    safe_normalize,
    safe_sqrt,
)


@given(st.integers(-150, 150), st.integers(0, 1000))
def test_norm_of_any_size(power, seed):
    x = np.random.default_rng(seed).normal(size=(4, 3)) * 10.0**power
    with jax.enable_x64(True):
        found = np.asarray(safe_norm(jnp.asarray(x)))
    assert found == pytest.approx(np.linalg.norm(x / 10.0**power, axis=-1) * 10.0**power)


@pytest.mark.parametrize(("axis", "keepdims"), [(-1, False), (0, True), (1, False), (-2, True)])
def test_norm_along_any_axis_and_its_derivatives(x64, axis, keepdims):
    x = jnp.asarray(np.random.default_rng(0).normal(size=(3, 4, 2)))
    expected = np.linalg.norm(x, axis=axis, keepdims=keepdims)
    np.testing.assert_allclose(safe_norm(x, axis, keepdims), expected)
    np.testing.assert_allclose(safe_norm(x, axis=axis, keepdims=keepdims), expected)
    check_grads(lambda x: safe_norm(x, axis, keepdims), (x,), 2, ("fwd", "rev"), eps=1e-5)


@pytest.mark.parametrize("function", [safe_norm, safe_normalize, safe_sqrt])
def test_derivatives_vanish_at_rest(x64, function):
    zero = jnp.zeros(3)
    assert not np.asarray(function(zero)).any()
    assert not np.asarray(jax.jacfwd(function)(zero)).any()
    assert not np.asarray(jax.jacrev(function)(zero)).any()
    assert np.isfinite(np.asarray(jax.jacfwd(jax.jacrev(function))(zero))).all()


def test_cross_is_the_cross_product(x64):
    rng = np.random.default_rng(1)
    a, b = jnp.asarray(rng.normal(size=(5, 1, 3))), jnp.asarray(rng.normal(size=(4, 3)))
    np.testing.assert_allclose(cross(a, b), np.cross(a, b), atol=1e-15)
    check_grads(cross, (a, b), 2, ("fwd", "rev"))


@pytest.mark.parametrize("size", [1, 127, 128, 129, 16384, 16385, 2_100_000])
def test_running_count_is_the_prefix_sum(size):
    flags = np.random.default_rng(size).uniform(size=size) < 0.9
    found = jax.jit(running_count)(jnp.asarray(flags))
    assert found.dtype == jnp.int32
    np.testing.assert_array_equal(found, np.cumsum(flags))


def test_running_count_of_a_batch_runs_along_the_last_axis():
    flags = np.random.default_rng(0).integers(0, 2, (2, 3, 300))
    np.testing.assert_array_equal(running_count(jnp.asarray(flags)), np.cumsum(flags, axis=-1))


def test_division_by_zero_gives_what_is_asked():
    assert float(safe_divide(jnp.array(3.0), jnp.array(0.0), fill=7.0)) == 7
    slope = jax.grad(lambda d: safe_divide(jnp.array(3.0), d))(0.0)
    assert float(slope) == 0


def test_quick_jit_is_jit():
    calls = []

    @quick_jit
    def doubled(x):
        """Twice."""
        calls.append(1)
        return 2 * x

    assert float(doubled(jnp.array(2.0))) == 4 and float(doubled(jnp.array(3.0))) == 6
    assert len(calls) == 1 and doubled.__doc__ == "Twice."
