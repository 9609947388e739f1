"""Non-negative least squares: against SciPy's active-set solver, conditions, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import nnls

from jaxface.solvers.nonnegative import nonnegative_least_squares


def problem(seed, rows=40, columns=12):
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(rows, columns)) * rng.uniform(0.1, 10, columns)
    return matrix, rng.normal(size=rows)


@pytest.mark.parametrize("seed", range(5))
def test_agrees_with_an_active_set_method(x64, seed):
    matrix, goal = problem(seed)
    found = nonnegative_least_squares(
        jnp.asarray(matrix.T @ matrix), jnp.asarray(matrix.T @ goal), steps=2000
    )
    np.testing.assert_allclose(found, nnls(matrix, goal)[0], atol=1e-9)


@given(st.integers(0, 10_000), st.integers(2, 15))
def test_the_optimality_conditions_hold(seed, columns):
    matrix, goal = problem(seed, columns=columns)
    gram, moment = (jnp.asarray(x, jnp.float32) for x in (matrix.T @ matrix, matrix.T @ goal))
    x = nonnegative_least_squares(gram, moment, steps=3000)
    scale = jnp.sqrt(jnp.diagonal(gram)) * np.linalg.norm(goal)
    slope = (gram @ x - moment) / scale
    assert (x >= 0).all()
    assert (slope > -1e-4).all()
    np.testing.assert_allclose(jnp.where(x > 0, slope, 0.0), 0.0, atol=1e-4)


def test_a_column_of_zeros_stays_at_zero():
    gram = jnp.diag(jnp.array([1.0, 0.0, 4.0]))
    found = nonnegative_least_squares(gram, jnp.array([2.0, 0.0, -1.0]))
    np.testing.assert_allclose(found, [2.0, 0.0, 0.0], atol=1e-5)
    nothing = nonnegative_least_squares(jnp.zeros((3, 3)), jnp.zeros(3))
    np.testing.assert_array_equal(nothing, 0.0)


def test_derivatives_agree_with_finite_differences(x64):
    matrix, goal = problem(7, columns=6)
    gram = jnp.asarray(matrix.T @ matrix)

    def solve(goal):
        return nonnegative_least_squares(gram, matrix.T @ goal, steps=1500)

    forward, reverse = jax.jacfwd(solve)(jnp.asarray(goal)), jax.jacrev(solve)(jnp.asarray(goal))
    steps = 1e-6 * np.eye(len(goal))
    numeric = np.stack([(solve(goal + e) - solve(goal - e)) / 2e-6 for e in steps], axis=1)
    np.testing.assert_allclose(forward, numeric, atol=1e-6)
    np.testing.assert_allclose(forward, reverse, atol=1e-9)


def test_many_problems_at_once():
    both = [problem(seed) for seed in (1, 2)]
    grams = jnp.stack([jnp.asarray(a.T @ a, jnp.float32) for a, _ in both])
    moments = jnp.stack([jnp.asarray(a.T @ b, jnp.float32) for a, b in both])
    together = jax.vmap(nonnegative_least_squares)(grams, moments)
    alone = [nonnegative_least_squares(g, m) for g, m in zip(grams, moments, strict=True)]
    np.testing.assert_allclose(together, jnp.stack(alone), rtol=1e-4, atol=1e-6)
