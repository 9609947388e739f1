"""Non-negative least squares: against SciPy's active-set solver, conditions, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import nnls

from jaxface.solvers.nonnegative import nonnegative_least_squares
from jaxface.solvers.solution import reason


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
    assert bool(found.converged) and float(found.stats["violation"]) < 1e-9
    np.testing.assert_allclose(found.value, nnls(matrix, goal)[0], atol=1e-9)


@given(st.integers(0, 10_000), st.integers(2, 15))
def test_the_optimality_conditions_hold(seed, columns):
    matrix, goal = problem(seed, columns=columns)
    gram, moment = (jnp.asarray(x, jnp.float32) for x in (matrix.T @ matrix, matrix.T @ goal))
    x = nonnegative_least_squares(gram, moment, steps=3000).value
    scale = jnp.sqrt(jnp.diagonal(gram)) * np.linalg.norm(goal)
    slope = (gram @ x - moment) / scale
    assert (x >= 0).all()
    assert (slope > -1e-4).all()
    np.testing.assert_allclose(jnp.where(x > 0, slope, 0.0), 0.0, atol=1e-4)


def test_a_column_of_zeros_stays_at_zero():
    gram = jnp.diag(jnp.array([1.0, 0.0, 4.0]))
    found = nonnegative_least_squares(gram, jnp.array([2.0, 0.0, -1.0])).value
    np.testing.assert_allclose(found, [2.0, 0.0, 0.0], atol=1e-5)
    nothing = nonnegative_least_squares(jnp.zeros((3, 3)), jnp.zeros(3))
    np.testing.assert_array_equal(nothing.value, 0.0)
    assert bool(nothing.converged)


def test_derivatives_agree_with_finite_differences(x64):
    matrix, goal = problem(7, columns=6)
    gram = jnp.asarray(matrix.T @ matrix)

    def solve(goal):
        return nonnegative_least_squares(gram, matrix.T @ goal, steps=1500).value

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
    alone = [nonnegative_least_squares(g, m).value for g, m in zip(grams, moments, strict=True)]
    assert together.converged.shape == (2,)
    together = together.value
    np.testing.assert_allclose(together, jnp.stack(alone), rtol=1e-4, atol=1e-6)


def test_too_few_steps_and_numbers_that_are_none_are_told():
    matrix, goal = problem(3)
    gram, moment = (jnp.asarray(x, jnp.float32) for x in (matrix.T @ matrix, matrix.T @ goal))
    early = nonnegative_least_squares(gram, moment, steps=3)
    assert not bool(early.converged) and reason(early) == "used all its steps"
    assert float(early.stats["violation"]) > 1e-4
    with jax.debug_nans(False):
        broken = nonnegative_least_squares(gram, moment.at[2].set(jnp.nan))
        assert "the gradient" in reason(broken) and not bool(broken.converged)


def test_columns_of_different_length_need_no_more_steps(x64):
    """Where ``optax.nnls``, without a scale of its own, is far from done."""
    matrix, goal = problem(11, rows=60, columns=20)
    matrix = matrix * np.logspace(-1, 1, 20)
    best = nnls(matrix, goal)[1] ** 2

    def excess(x):
        return float(jnp.sum((matrix @ x - goal) ** 2) / best - 1)

    ours = nonnegative_least_squares(matrix.T @ matrix, matrix.T @ goal, steps=300)
    assert excess(ours.value) < 1e-9
    assert excess(optax.nnls(jnp.asarray(matrix), jnp.asarray(goal), 300)) > 1e-4
