"""Damped Gauss-Newton: against independent solvers on problems with known answers."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from hypothesis import given
from hypothesis import strategies as st

from jaxface.energies.term import Term, compose
from jaxface.solvers._gauss_newton import gauss_newton
from jaxface.solvers._least_squares import least_squares
from jaxface.solvers._posterior_covariance import posterior_covariance
from jaxface.solvers.problem import Problem
from jaxface.solvers.solution import reason


def _problem(fn):
    energy = compose([Term("r", fn)])
    return Problem(energy.value, energy.quadratic)


def rosenbrock(y, args):
    return jnp.stack([10 * (y[1] - y[0] ** 2), args - y[0]])


@partial(jax.jit, static_argnames="steps")
def solve_rosenbrock(start, target, steps):
    """The found minimum, compiled once for all starts."""
    return gauss_newton(_problem(rosenbrock), start, target, steps=steps).value


def powell_singular(y, args):
    a, b, c, d = y
    root5, root10 = jnp.sqrt(5.0), jnp.sqrt(10.0)
    return jnp.stack([a + 10 * b, root5 * (c - d), (b - 2 * c) ** 2, root10 * (a - d) ** 2])


def exponential_fit(y, args):
    t, observed = args
    return y[0] * jnp.exp(-y[1] * t) + y[2] - observed


_T = np.linspace(0, 4, 30)
PROBLEMS = {
    "rosenbrock": (rosenbrock, np.array([-1.2, 1.0]), np.array(1.0)),
    "powell": (powell_singular, np.array([3.0, -1.0, 0.0, 1.0]), None),
    "exponential": (
        exponential_fit,
        np.array([1.0, 0.3, 0.0]),
        (_T, 2.5 * np.exp(-1.3 * _T) + 0.5 + 0.05 * np.sin(17 * _T)),
    ),
}


@pytest.mark.parametrize("name", PROBLEMS)
def test_agrees_with_scipy(x64, name):
    fn, start, args = PROBLEMS[name]
    args = jax.tree.map(jnp.asarray, args)
    ours = gauss_newton(_problem(fn), jnp.asarray(start), args, steps=200, rtol=1e-14)
    compiled = jax.jit(fn)
    theirs = scipy.optimize.least_squares(
        lambda y: np.asarray(compiled(y, args)), start, xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    value = float(jnp.sum(fn(ours.value, args) ** 2))
    assert value <= 2 * theirs.cost + 1e-12
    tolerance = 2e-2 if name == "powell" else 1e-5
    np.testing.assert_allclose(ours.value, theirs.x, atol=tolerance)


@pytest.mark.parametrize("method", ["levenberg_marquardt", "gauss_newton", "dogleg"])
def test_least_squares_methods_agree(x64, method):
    fn, _, args = PROBLEMS["exponential"]
    args = jax.tree.map(jnp.asarray, args)
    start = jnp.array([2.0, 1.0, 0.3])
    found = least_squares(fn, start, args, method=method, rtol=1e-10, atol=1e-10)
    ours = gauss_newton(_problem(fn), start, args, steps=50, rtol=1e-14)
    np.testing.assert_allclose(found.value, ours.value, atol=1e-6)
    assert bool(found.converged) and reason(found.result) == "converged"


def test_unknown_method_is_named():
    with pytest.raises(ValueError, match="newton_raphson"):
        least_squares(rosenbrock, jnp.zeros(2), 1.0, method="newton_raphson")


def test_descends_where_plain_gauss_newton_diverges(x64):
    """r = atan(y): undamped steps overshoot further each time from |y| > 1.39."""

    def fn(y, args):
        return jnp.arctan(y)

    y = 3.0
    for _ in range(5):
        y = y - np.arctan(y) * (1 + y * y)
    assert abs(y) > 1e3
    ours = gauss_newton(_problem(fn), jnp.array([3.0]), steps=50, rtol=1e-12)
    assert abs(float(ours.value[0])) < 1e-5
    history = np.asarray(ours.stats["history"]["total"])
    history = history[np.isfinite(history)]
    assert (np.diff(history) <= 0).all()


@pytest.mark.parametrize("limit", [0, 1, 3])
def test_the_limit_of_a_call_may_be_traced(x64, limit):
    def run(limit=None, steps=limit):
        problem = _problem(lambda y, args: jnp.arctan(y))
        return gauss_newton(problem, jnp.array([3.0]), steps=steps, limit=limit, rtol=0.0)

    found = jax.jit(lambda n: run(n, 10))(limit)
    expected = run()
    np.testing.assert_allclose(found.value, expected.value)
    assert int(found.stats["num_steps"]) == int(expected.stats["num_steps"])
    total = np.asarray(found.stats["history"]["total"])
    assert total.shape == (11,) and np.isposinf(total[limit + 1 :]).all()


def test_linear_problem_is_solved_by_normal_equations(x64):
    rng = np.random.default_rng(0)
    a, b = jnp.asarray(rng.normal(size=(20, 5))), jnp.asarray(rng.normal(size=20))
    found = gauss_newton(
        _problem(lambda y, args: args[0] @ y - args[1]), jnp.zeros(5), (a, b), steps=20, rtol=0.0
    )
    expected = np.linalg.lstsq(np.asarray(a), np.asarray(b), rcond=None)[0]
    np.testing.assert_allclose(found.value, expected, atol=1e-6)


def test_implicit_derivative_of_the_minimiser(x64):
    """y*(b) of ||A y - b||^2 + |y|^4 against finite differences of the solve."""
    rng = np.random.default_rng(1)
    a, b = jnp.asarray(rng.normal(size=(8, 3))), jnp.asarray(rng.normal(size=8))
    direction = jnp.asarray(rng.normal(size=8))

    def fn(y, b):
        return jnp.concatenate([a @ y - b, jnp.sum(y * y)[None]])

    @jax.jit
    def minimiser(b):
        return gauss_newton(_problem(fn), jnp.zeros(3), b, steps=100, rtol=0.0).value

    forward = jax.jvp(minimiser, (b,), (direction,))[1]
    reverse = jax.jit(jax.jacrev(minimiser))(b) @ direction
    step = 1e-4
    central = (minimiser(b + step * direction) - minimiser(b - step * direction)) / (2 * step)
    np.testing.assert_allclose(forward, central, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(reverse, forward, rtol=1e-6)


def test_vmap_equals_one_by_one():
    starts = jnp.asarray(np.random.default_rng(2).normal(size=(4, 2)), jnp.float32)
    targets = jnp.array([1.0, 0.5, -0.5, 2.0])

    solve = partial(solve_rosenbrock, steps=60)
    together = jax.jit(jax.vmap(solve))(starts, targets)
    apart = jnp.stack([solve(s, t) for s, t in zip(starts, targets, strict=True)])
    np.testing.assert_allclose(together, apart, rtol=2e-3, atol=2e-3)


@given(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3))
def test_never_above_the_start_and_never_nan(a, b):
    start = jnp.array([a, b], jnp.float32)
    found = np.asarray(solve_rosenbrock(start, jnp.float32(1.0), steps=5))
    before = float(jnp.sum(rosenbrock(start, 1.0) ** 2))
    after = float(jnp.sum(rosenbrock(found, 1.0) ** 2))
    assert np.isfinite(found).all()
    assert after <= before * (1 + 1e-5)


def test_zero_steps_return_the_start():
    found = gauss_newton(_problem(rosenbrock), jnp.array([3.0, 4.0]), jnp.float32(1.0), steps=0)
    np.testing.assert_array_equal(found.value, [3.0, 4.0])


def test_posterior_of_a_linear_gaussian_model(x64):
    """x ~ N(0, I) seen through A with noise s: covariance (I + A^T A / s^2)^-1."""
    a = jnp.asarray(np.random.default_rng(3).normal(size=(10, 4)))
    sigma, weight = 0.3, 2.5e-5
    curvature = weight * (jnp.eye(4) + a.T @ a / sigma**2)
    expected = np.linalg.inv(np.eye(4) + np.asarray(a.T @ a) / sigma**2)
    found = posterior_covariance(curvature, 2 * weight)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-7)


def test_the_ridge_of_a_posterior_bounds_what_nothing_says(x64):
    """Two unknowns of which only the sum is seen: variance 1 / ridge along the difference."""
    found = posterior_covariance(jnp.ones((2, 2)), 2.0)
    expected = np.linalg.inv(np.ones((2, 2)) + 1e-7 * np.eye(2))
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    np.testing.assert_allclose(found, np.asarray(found).T, rtol=1e-12)


def test_a_posterior_without_a_factor_gets_a_larger_ridge():
    matrix = jnp.array([[1.0, 1.02], [1.02, 1.0]])  # an eigenvalue of -0.02
    found = np.asarray(posterior_covariance(matrix, 2.0))
    np.testing.assert_allclose(found, np.linalg.inv(matrix + 0.1 * np.eye(2)), rtol=1e-4)
    assert (np.linalg.eigvalsh(found) > 0).all()


def test_answers_are_differentiable_in_the_weights_of_terms(x64):
    """Weights that terms read from the data reach the answer by the implicit function theorem."""
    goal = jnp.array([0.7, -0.4, 0.2])
    energy = compose(
        [
            Term("data", lambda y, d: jnp.sin(y) - goal, lambda d: d["data"]),
            Term("prior", lambda y, d: y, lambda d: d["prior"]),
        ]
    )

    def solved(weights):
        problem = Problem(energy.value, energy.quadratic)
        return gauss_newton(problem, jnp.zeros(3), weights, steps=60, rtol=1e-15).value

    at = {"data": jnp.asarray(2.0), "prior": jnp.asarray(0.3)}
    forward, reverse = jax.jacfwd(solved)(at), jax.jacrev(solved)(at)
    for name in at:
        up, down = ({**at, name: at[name] + s} for s in (1e-5, -1e-5))
        numeric = (solved(up) - solved(down)) / 2e-5
        assert float(jnp.abs(numeric).min()) > 1e-3
        np.testing.assert_allclose(forward[name], numeric, rtol=1e-6)
        np.testing.assert_allclose(reverse[name], numeric, rtol=1e-6)
