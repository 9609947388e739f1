"""Terms and their sum: what is refused, derivatives in weights, and other people's solvers."""

import re
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxface.energies.term import Term, compose, quadratic_by_autodiff
from jaxface.solvers._gauss_newton import gauss_newton
from jaxface.solvers.problem import Problem

PAGE = Path(__file__).resolve().parent.parent / "docs" / "choosing.md"


def own(y, args):
    return y - 2.0


@pytest.mark.parametrize(
    "weight",
    [-1.0, np.float32(-1.0), np.float64(-1e-9), jnp.asarray(-1.0), np.asarray(-2), -1,
     float("nan"), 1.0 + 0.0j, np.ones(2)],
    ids=repr,
)  # fmt: skip
def test_weights_that_are_no_weights_are_refused(weight):
    with jax.debug_nans(False), pytest.raises(ValueError, match="term 'mine' has weight"):
        compose([Term("mine", own, weight)])


@pytest.mark.parametrize("weight", [0, 0.0, 2, np.float32(0.5), jnp.asarray(1.5), np.asarray(3.0)])
def test_other_weights_count(weight):
    energy = compose([Term("mine", own, weight)])
    value, parts = energy.value(jnp.zeros(3), None)
    np.testing.assert_allclose(value, 12.0 * float(weight))
    np.testing.assert_allclose(parts["mine"], energy.total(jnp.zeros(3), None))
    residual = energy.residual(jnp.zeros(3), None)["mine"]
    np.testing.assert_allclose(jnp.sum(residual**2), value, rtol=1e-6)
    assert residual.dtype == value.dtype == jnp.zeros(3).dtype


def test_a_wider_weight_does_not_widen_the_energy(x64):
    energy = compose([Term("mine", own, np.float64(2.0)), Term("data", own, lambda args: args)])
    y = jnp.zeros(3, jnp.float32)
    value, _ = energy.value(y, jnp.asarray(1.0, jnp.float64))
    model, _ = energy.quadratic(y, jnp.asarray(1.0, jnp.float64))
    assert value.dtype == model.value.dtype == model.curvature.dtype == jnp.float32


def test_complex_terms_are_refused():
    energy = compose([Term("wave", lambda y, args: y + 1j)])
    for call in (energy.value, energy.residual, energy.quadratic, jax.jit(energy.total)):
        with pytest.raises(ValueError, match="term 'wave' gives complex"):
            call(jnp.zeros(2), None)


def test_a_scalar_term_gives_one_number():
    energy = compose([Term("mine", own, kind="scalar")])
    with pytest.raises(ValueError, match=r"term 'mine' is scalar.*\(3,\)"):
        energy.value(jnp.zeros(3), None)


def test_a_residual_has_a_derivative_in_a_weight_of_zero(x64):
    energy = compose([Term("mine", own, lambda w: w), Term("rest", own, 2.0)])
    y = jnp.array([1.0, 0.5])

    def residual(w):
        return energy.residual(y, w)["mine"]

    np.testing.assert_array_equal(residual(jnp.asarray(0.0)), 0.0)
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_array_equal(mode(residual)(jnp.asarray(0.0)), 0.0)
        np.testing.assert_allclose(mode(residual)(jnp.asarray(4.0)), own(y, None) / 4)
        # that of the energy is exact there
        slope = mode(lambda w: energy.total(y, w))(jnp.asarray(0.0))
        np.testing.assert_allclose(slope, jnp.sum(own(y, None) ** 2))


def test_a_negative_weight_from_the_data_does_not_vanish():
    energy = compose([Term("mine", own, lambda w: w)])
    with jax.debug_nans(False):
        assert np.isnan(energy.residual(jnp.zeros(2), jnp.asarray(-1.0))["mine"]).all()


def test_the_sum_of_models_says_which_was_not_finite():
    energy = compose([Term("a", own), Term("b", lambda y, args: jnp.sqrt(jnp.abs(y)))])
    with jax.debug_nans(False):
        model, _ = energy.quadratic(jnp.zeros(2), None)
    assert model.not_finite is not None
    np.testing.assert_array_equal(model.not_finite["a"], [False, False, False])
    np.testing.assert_array_equal(model.not_finite["b"], [False, True, True])
    assert quadratic_by_autodiff(Term("a", own))(jnp.zeros(2), None).not_finite is None


def test_a_sweep_over_a_weight_runs_one_program(x64):
    traces = []

    def counted(y, args):
        traces.append(1)
        return y - args["goal"]

    energy = compose([Term("data", counted), Term("prior", lambda y, a: y, lambda a: a["prior"])])

    @jax.jit
    def solved(prior):
        args = {"goal": jnp.array([1.0, 2.0]), "prior": prior}
        return gauss_newton(Problem.of(energy), jnp.zeros(2), args, rtol=1e-14).value

    solved(jnp.asarray(1.0))
    first = len(traces)
    for prior in (0.0, 0.3, 3.0):
        found = solved(jnp.asarray(prior))
        np.testing.assert_allclose(found, np.array([1.0, 2.0]) / (1 + prior), rtol=1e-6)
    assert len(traces) == first
    slope = jax.jacfwd(solved)(jnp.asarray(0.3))
    np.testing.assert_allclose(slope, -np.array([1.0, 2.0]) / 1.3**2, rtol=1e-5)


def test_the_page_on_solvers_runs_with_every_back_end(x64):
    """Its blocks in order: the same energy by ours, optimistix, jaxopt and optax."""
    text = PAGE.read_text("utf-8").split("## The solver")[1]
    names: dict = {}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "JAXopt is no longer maintained", DeprecationWarning)
        for number, body in enumerate(re.findall(r"^```python\n(.*?)^```", text, re.M | re.S)):
            exec(compile(body, f"choosing.md, block {number + 1}", "exec"), names)
    assert {"optimistix.least_squares", "optimistix.minimise", "jaxopt", "optax"} <= set(
        names["answers"]
    )
    expected = names["answers"]["gauss_newton"]
    np.testing.assert_allclose(expected["scale"], 2.0, atol=0.02)
    for name, answer in names["answers"].items():
        for key in expected:
            np.testing.assert_allclose(answer[key], expected[key], rtol=2e-3, err_msg=name)
    assert names["reason"](names["found"]) == "converged"
    assert names["rates"][0] > names["rates"][1] > names["rates"][2] > 1.0
    assert names["rate"]._cache_size() == 1 and float(names["slope"]) < 0
