"""L-BFGS behind one call, on problems with known answers and beside SciPy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxface.solvers._minimise import METHODS, minimise
from jaxface.solvers.lbfgs import LBFGSState


def rosenbrock(y, args):
    x = y["x"]
    return jnp.sum(args * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)


@pytest.mark.parametrize("method", METHODS)
def test_rosenbrock_reaches_ones(method, x64):
    found = minimise(
        rosenbrock, {"x": jnp.full(6, -0.5)}, jnp.asarray(100.0), method=method, steps=300,
        rtol=1e-10,
    )  # fmt: skip
    np.testing.assert_allclose(found.value["x"], 1.0, atol=1e-4)
    assert int(found.stats["num_steps"]) < 300


def test_no_more_evaluations_than_scipy_needs(x64):
    start = np.full(20, -0.5)
    value = jax.jit(jax.value_and_grad(lambda x: rosenbrock({"x": x}, 100.0)))
    theirs = scipy.optimize.minimize(
        lambda x: tuple(np.asarray(a, float) for a in value(x)), start, jac=True,
        method="L-BFGS-B", options={"maxcor": 10, "ftol": 1e-12, "gtol": 1e-8},
    )  # fmt: skip
    ours = minimise(rosenbrock, {"x": jnp.asarray(start)}, 100.0, steps=1000, rtol=1e-12)
    assert ours.stats["values"][-1] <= theirs.fun + 1e-8
    assert ours.stats["evaluations"] <= 1.5 * theirs.nfev


def test_quadratics_of_any_shape_are_solved():
    @settings(deadline=None, max_examples=20)
    @given(st.integers(0, 10_000), st.integers(1, 12))
    def check(seed, size):
        rng = np.random.default_rng(seed)
        root = rng.normal(size=(size, size))
        matrix = jnp.asarray(root @ root.T + 0.1 * np.eye(size))
        goal = jnp.asarray(rng.normal(size=size))
        found = minimise(
            lambda y, a: (y - a) @ matrix @ (y - a), jnp.zeros(size), goal, steps=200, rtol=1e-14
        )
        np.testing.assert_allclose(found.value, goal, atol=1e-4)

    with jax.enable_x64(True):
        check()


def test_values_never_rise_and_are_reported():
    found = minimise(rosenbrock, {"x": jnp.full(6, -0.5)}, 100.0, steps=30)
    values = found.stats["values"]
    assert len(values) == found.stats["num_steps"] + 1
    assert (np.diff(values) <= 0).all()


def test_a_run_goes_on_from_its_state():
    kept: list[LBFGSState] = []

    def watch(step, state):
        kept.append(state)
        return step == 7

    start = {"x": jnp.full(6, -0.5)}
    first = minimise(rosenbrock, start, 100.0, steps=20, on_step=watch)
    assert first.stats["num_steps"] == 7
    rest = minimise(rosenbrock, start, 100.0, steps=13, state=kept[-1])
    whole = minimise(rosenbrock, start, 100.0, steps=20)
    np.testing.assert_allclose(rest.value["x"], whole.value["x"], rtol=1e-6)


def test_at_the_minimum_nothing_moves():
    found = minimise(lambda y, _: jnp.sum(y**2), jnp.zeros(4), steps=5)
    np.testing.assert_array_equal(found.value, 0.0)
    assert bool(found.converged)


def test_steps_into_nan_are_shortened():
    found = minimise(
        lambda y, _: jnp.sum(y - jnp.log(y)), jnp.full(3, 0.2), steps=50, first_change=5.0
    )
    np.testing.assert_allclose(found.value, 1.0, atol=1e-3)


def test_optimistix_is_differentiable_in_the_data(x64):
    def solved(goal):
        return minimise(
            lambda y, a: jnp.sum((y - a) ** 4 + (y - a) ** 2), jnp.zeros(3), goal,
            method="optimistix", rtol=1e-9, steps=200,
        ).value  # fmt: skip

    np.testing.assert_allclose(jax.jacrev(solved)(jnp.arange(3.0)), np.eye(3), atol=1e-4)


def test_wrong_calls_are_told():
    with pytest.raises(ValueError, match="one of"):
        minimise(rosenbrock, jnp.zeros(2), method="newton")
    with pytest.raises(ValueError, match="belong to method 'lbfgs'"):
        minimise(rosenbrock, jnp.zeros(2), method="jaxopt", on_step=lambda i, s: None)
    with pytest.raises(ValueError, match="finite"):
        minimise(lambda y, _: jnp.sum(y) / 0.0, jnp.ones(2))
