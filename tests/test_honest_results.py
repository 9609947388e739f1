"""What solvers say of their answers: converged, stuck, out of steps, or which number was none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxface.energies.term import Term, compose
from jaxface.solvers._gauss_newton import gauss_newton
from jaxface.solvers._least_squares import least_squares
from jaxface.solvers._minimise import METHODS, minimise
from jaxface.solvers.finiteness import NotFiniteError, not_finite_words, require_finite
from jaxface.solvers.problem import Problem
from jaxface.solvers.solution import reason

SQUARES = ("levenberg_marquardt", "gauss_newton", "dogleg")


@pytest.fixture
def numbers_may_fail():
    """NaN is fed on purpose."""
    with jax.debug_nans(False):
        yield


@jax.custom_jvp
def no_slope(x):
    """One, with a derivative that is NaN."""
    return x * 0 + 1.0


no_slope.defjvp(lambda x, t: (x[0] * 0 + 1.0, t[0] * jnp.nan))


@jax.custom_jvp
def wrong_slope(x):
    """A square, with a derivative that points uphill."""
    return x * x


wrong_slope.defjvp(lambda x, t: (x[0] ** 2, -2 * x[0] * t[0]))

FAULTS = {
    "value": lambda y, args: jnp.sqrt(-1.0 - y[0] ** 2),
    "gradient": lambda y, args: no_slope(y[0]),
}


def with_fault(name, kind="residual"):
    return compose([Term("sound", lambda y, args: y - 1.0), Term("mine", FAULTS[name], 1.0, kind)])


def two_wells(y, args):
    return (y[0] ** 2 - 1.0) ** 2


MIXED = Problem.of(
    compose([Term("wells", two_wells, 1.0, "scalar"), Term("line", lambda y, args: y[1] - 3.0)])
)


@pytest.mark.parametrize("start", [(0.1, 0.5), (0.5, 0.1), (-0.01, 9.0)])
def test_where_the_curvature_is_negative_steps_descend(start):
    found = gauss_newton(MIXED, jnp.array(start))
    np.testing.assert_allclose(found.value, [np.sign(start[0]), 3.0], atol=1e-3)
    assert reason(found) == "converged" and int(found.stats["num_steps"]) > 1
    totals = np.asarray(found.stats["history"]["total"])
    assert (np.diff(totals[np.isfinite(totals)]) <= 0).all()


@pytest.mark.parametrize(
    ("count", "energy", "least"),
    [
        # zero diagonal, and one eigenvector that much damping alone makes positive
        (2, lambda y, args: y[0] * y[1] + 0.1 * jnp.sum(y**4), -2.5 / 4 * 2),
        (40, lambda y, args: jnp.sum(y**4) - jnp.sum(y) ** 2 / 40, -40 / 4),
        (2, lambda y, args: 1e8 * two_wells(y, args) + (y[1] - 1.0) ** 2, 0.0),
    ],
    ids=["saddle", "one direction", "units"],
)
def test_indefinite_energies_are_minimised(count, energy, least, x64):
    start = jnp.linspace(0.01, 0.03, count)
    found = gauss_newton(Problem.of(compose([Term("e", energy, 1.0, "scalar")])), start, steps=80)
    assert bool(found.converged)
    np.testing.assert_allclose(energy(found.value, None), least, atol=1e-2 + 1e-2 * abs(least))


def test_a_saddle_point_is_a_stationary_point():
    found = gauss_newton(MIXED, jnp.array([0.0, 0.5]), rtol=1e-7)
    np.testing.assert_allclose(found.value, [0.0, 3.0], atol=5e-3)


@pytest.mark.parametrize("kind", ["residual", "scalar"])
@pytest.mark.parametrize("quantity", FAULTS)
def test_gauss_newton_names_the_term(quantity, kind, numbers_may_fail):
    found = gauss_newton(Problem.of(with_fault(quantity, kind)), jnp.array([0.1, 0.5]))
    np.testing.assert_array_equal(found.value, jnp.array([0.1, 0.5]))
    assert not bool(found.converged)
    assert f"the {quantity}" in reason(found) and "'mine'" in reason(found)
    assert "sound" not in reason(found)
    with pytest.raises(NotFiniteError, match="my fit met.*'mine'"):
        require_finite(found.stats["not_finite"], "my fit")


@pytest.mark.parametrize("method", SQUARES)
@pytest.mark.parametrize("quantity", FAULTS)
def test_least_squares_names_the_term(quantity, method, numbers_may_fail):
    energy = with_fault(quantity)
    found = least_squares(energy.residual, jnp.array([0.1, 0.5]), method=method)
    assert not bool(found.converged)
    assert f"the {quantity}" in reason(found) and reason(found).endswith("'mine'")


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("quantity", FAULTS)
def test_minimise_names_the_term(quantity, method, numbers_may_fail):
    energy, start = with_fault(quantity), jnp.array([0.1, 0.5])
    if (method, quantity) == ("lbfgs", "value"):
        with pytest.raises(NotFiniteError, match="must be finite: the value of 'mine'"):
            minimise(energy.value, start, method=method)
        return
    found = minimise(energy.value, start, method=method)
    np.testing.assert_array_equal(found.value, start)
    assert not bool(found.converged)
    assert f"the {quantity}" in reason(found) and reason(found).endswith("'mine'")


def test_an_infinite_energy_is_no_descent(numbers_may_fail):
    """Minus infinity lies below every number, and is none."""

    def fn(y, args):
        return jnp.sum(jnp.where(y > 1.0, -jnp.inf, (y - 1.5) ** 2))

    found = minimise(fn, jnp.array([0.3]))
    assert np.isfinite(found.stats["values"]).all() and float(found.value[0]) <= 1.0
    found = gauss_newton(Problem.of(compose([Term("e", fn, 1.0, "scalar")])), jnp.array([0.3]))
    assert np.isfinite(fn(found.value, None)) and float(found.value[0]) <= 1.0


def test_a_wall_of_numbers_that_are_none_is_no_minimum(numbers_may_fail):
    def fn(y, args):
        return jnp.where(y == 0.3, y - 1.0, jnp.nan)

    found = gauss_newton(Problem.of(compose([Term("wall", fn)])), jnp.array([0.3]))
    assert reason(found) == "not finite (NaN or infinite): the value of 'wall'"


def test_a_start_that_is_no_number_is_told(numbers_may_fail):
    found = gauss_newton(MIXED, jnp.array([jnp.nan, 0.0]))
    assert not bool(found.converged)
    assert reason(found) == "not finite (NaN or infinite): the unknowns"


@pytest.mark.parametrize("method", METHODS)
def test_minimise_with_a_wrong_slope_is_stuck(method):
    found = minimise(lambda y, args: jnp.sum(wrong_slope(y)), jnp.array([0.3, 0.1]), method=method)
    assert not bool(found.converged) and "stuck" in reason(found)


def test_gauss_newton_with_a_wrong_slope_is_stuck():
    energy = compose([Term("e", lambda y, args: jnp.sum(wrong_slope(y)) + 1.0, 1.0, "scalar")])

    def quadratic(y, args):
        value, parts = energy.value(y, args)
        return (value, -2 * y, jnp.eye(2)), parts

    found = gauss_newton(Problem(energy.value, quadratic), jnp.array([0.3, 0.1]))
    assert not bool(found.converged) and "stuck" in reason(found)


def test_steps_that_ran_out_are_no_convergence():
    for steps in (0, 1):
        found = gauss_newton(MIXED, jnp.array([0.1, 0.5]), steps=steps)
        assert not bool(found.converged) and reason(found) == "used all its steps"
    found = minimise(lambda y, args: jnp.sum((y - 1) ** 2), jnp.zeros(2), steps=1)
    assert reason(found) == "used all its steps"
    found = minimise(
        lambda y, args: jnp.sum((y - 1) ** 2), jnp.zeros(2), on_step=lambda step, state: True
    )
    assert reason(found) == "ended by on_step"


def test_at_the_minimum_all_say_so():
    def fn(y, args):
        return y - 1.0

    energy, at = compose([Term("r", fn)]), jnp.ones(2)
    found = [gauss_newton(Problem.of(energy), at), least_squares(energy.residual, at)]
    found += [minimise(energy.value, at, method=method) for method in METHODS]
    assert [reason(one) for one in found] == ["converged"] * len(found)


def test_results_and_flags_survive_jit_and_vmap(numbers_may_fail):
    energy = compose(
        [
            Term("wells", two_wells, 1.0, "scalar"),
            Term("line", lambda y, goal: y[1] - goal),
        ]
    )

    def solve(goal):
        found = gauss_newton(Problem.of(energy), jnp.array([0.1, 0.5]), goal)
        return found.value, found.converged, found.stats["not_finite"]

    goals = jnp.array([3.0, jnp.nan, -2.0])
    value, converged, not_finite = jax.jit(jax.vmap(solve))(goals)
    np.testing.assert_array_equal(converged, [True, False, True])
    np.testing.assert_allclose(value, [[1.0, 3.0], [0.1, 0.5], [1.0, -2.0]], atol=1e-3)
    assert not_finite["line"].shape == (3, 3)
    np.testing.assert_array_equal(not_finite["line"][:, 0], [False, True, False])
    assert not np.asarray(not_finite["wells"]).any()
    assert not_finite_words(not_finite) == "the value and the gradient of 'line'"


def test_words_leave_out_the_whole_where_a_term_is_to_blame():
    flags = {"a": jnp.array([False, True, False]), "total": jnp.array([False, True, False])}
    assert not_finite_words(flags) == "the gradient of 'a'"
    assert not_finite_words({"total": flags["total"]}) == "the gradient of the energy"
    assert not_finite_words({"a": jnp.zeros(3, bool)}) == ""
    require_finite({"a": jnp.zeros(3, bool)}, "a solve")
