"""A fit handed on: its problem for any solver, its start for the next, terms and data of one's own.

One small face, whose programs are compiled once: what is data in a fit needs no other.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from jaxface.energies.term import Term, sum_of_squares
from jaxface.models.parameters import put_together
from jaxface.pipeline import fit
from jaxface.pipeline.fitting import _fit
from jaxface.run import clock as clocks
from jaxface.stages.fit import FitOptions, FitWeights, no_history, working_photo
from tests.small_fit import small_face, small_photo


def pull(y, data):
    """Towards a target that the caller gives."""
    return y.identity - data.user["target"]


@pytest.fixture(scope="module")
def scene():
    model = small_face()
    photo, points, truth = small_photo(model)
    # The depth of a detector: any third number.
    return model, photo, np.column_stack([points, np.arange(68.0)]), truth


def small_fit(scene, weight=1e-3, target=0.0, **given):
    model, photo, points, _ = scene
    options = FitOptions(
        size=64, steps=(12,), details=(0,), self_shadow=False, compared_pixels=1000,
        extra_terms=(Term("pull", pull, weight),),
    )  # fmt: skip
    mask = np.ones(photo.shape[:2])
    user = {"target": np.full(5, target, np.float32)}
    return fit(photo, model, options, landmarks=points, mask=mask, user=user, **given)


@pytest.fixture(scope="module")
def fitted(scene):
    return small_fit(scene)


def compiled():
    return len(clocks._PROGRAMS)


def test_another_weight_and_other_data_are_the_same_program(scene, fitted):
    before = compiled()
    drawn = small_fit(scene, weight=10.0, target=2.0)
    assert compiled() == before
    np.testing.assert_allclose(drawn.parameters.identity, 2.0, atol=0.05)
    assert float(jnp.max(jnp.abs(fitted.parameters.identity))) < 1.5


def test_the_problem_is_that_of_the_last_step(fitted):
    energy, y, data = fitted.problem()
    total, parts = energy.value(y, data)
    history, used = fitted.stats.energies[-1], int(fitted.stats.steps[-1])
    assert set(parts) == {*history} - {"total"} and "pull" in parts
    assert float(total) == pytest.approx(float(history["total"][used]), rel=2e-2)
    assert float(parts["pull"]) == pytest.approx(float(history["pull"][used]), rel=1e-3)
    np.testing.assert_array_equal(data.user["target"], 0.0)
    assert data.held is None
    slope = jax.grad(lambda y: energy.value(y, data)[0])(y)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(slope))


def test_a_fit_goes_on_where_another_ended(scene, fitted):
    before = compiled()
    again = small_fit(scene, start=fitted)
    assert compiled() == before
    # No landmark-only start: the first energy is that of the problem at the other's end.
    assert len(again.stats.energies) == 1
    energy, y, data = fitted.problem()
    first = float(again.stats.energies[0]["total"][0])
    assert first == pytest.approx(float(energy.value(y, data)[0]), rel=1e-4)
    by_numbers = small_fit(scene, start=fitted.parameters)
    pairs = zip(*map(jax.tree.leaves, (again.parameters, by_numbers.parameters)), strict=True)
    assert all(np.array_equal(a, b) for a, b in pairs)


def test_a_start_that_does_not_fit_is_told(scene, fitted):
    short = dataclasses.replace(fitted.parameters, identity=jnp.zeros(3))
    with pytest.raises(ValueError, match="identity of shape .3,."):
        small_fit(scene, start=short)
    gone = dataclasses.replace(fitted.parameters, rotation=jnp.full(3, jnp.nan))
    with pytest.raises(ValueError, match="start has rotation"):
        small_fit(scene, start=gone)


def test_the_start_of_another_photo_is_in_its_units(scene, fitted):
    model, photo, points, _ = scene
    wider = (points[:, :2] - 48) * 1.1 + 48
    mask = np.ones(photo.shape[:2])
    other = working_photo(0.5 * fitted.photo, wider, mask=mask, size=64)
    y = _fit._begun(fitted, model, other, FitOptions())
    sides = fitted.working.crop.side / other.crop.side
    assert sides < 0.95 and other.gain > 1.5 * fitted.working.gain
    assert float(jnp.exp(y.log_focal - fitted.parameters.log_focal)) == pytest.approx(sides, 1e-5)
    gain = other.gain / fitted.working.gain
    np.testing.assert_allclose(y.light, gain * fitted.parameters.light, rtol=1e-5)
    known = _fit._begun(fitted, model, other, FitOptions(focal=50.0))
    assert float(known.log_focal) == float(other.data.log_focal)


def test_the_landmarks_begin_a_fit_that_gives_them_no_weight(scene):
    before = compiled()
    blind = small_fit(scene, weights=FitWeights(landmark=0.0))
    assert compiled() == before
    start, used = blind.stats.energies[0]["landmark"], int(blind.stats.steps[0])
    assert used > 1 and float(start[used]) < 0.5 * float(start[0])
    assert float(blind.stats.energies[1]["landmark"][0]) == 0.0


def test_a_term_that_is_not_finite_is_told(scene, fitted):
    with pytest.raises(ValueError, match="the value .*of 'pull'"):
        small_fit(scene, target=np.nan)
    with pytest.raises(ValueError, match="no posterior"):
        _ = dataclasses.replace(fitted, stats=no_history()).posterior


def test_a_derivative_that_is_not_finite_is_told(fitted):
    levels = len(fitted.stats.steps)

    def flagged(*quantities):
        flags = {"photo": jnp.array(quantities), "prior": jnp.zeros(3, bool)}
        return dataclasses.replace(fitted.stats, not_finite=(*[{}] * (levels - 1), flags))

    steep = flagged(False, True, False)
    with pytest.raises(ValueError, match="the gradient of 'photo'"):
        _fit._check_finite(fitted.parameters, steep)
    lost = dataclasses.replace(fitted.parameters, light=jnp.full((9, 3), jnp.nan))
    with pytest.raises(ValueError, match="did not stay finite"):
        _fit._check_finite(lost, fitted.stats)
    # A step to where a term is not finite was not taken: its values all are.
    _fit._check_finite(fitted.parameters, flagged(True, False, False))
    _fit._check_finite(fitted.parameters, fitted.stats)


def test_what_is_made_of_a_fit_is_made_once(fitted):
    rendered = fitted.render()
    assert fitted.render() is rendered
    assert fitted.posterior is fitted.posterior
    np.testing.assert_array_equal(fitted.skin_map(), fitted.working.data.mask)  # as it was given
    moved = dataclasses.replace(
        fitted, parameters=dataclasses.replace(fitted.parameters, light=-fitted.parameters.light)
    )
    np.testing.assert_allclose(moved.render().color, -rendered.color, atol=1e-6)


def test_the_detectors_depth_is_kept(scene, fitted):
    np.testing.assert_array_equal(fitted.landmark_depth, np.arange(68.0))
    assert fitted.landmarks.shape == (68, 2)
    flat = small_fit((*scene[:2], scene[2][:, :2], scene[3]))
    assert flat.landmark_depth is None
    with pytest.raises(ValueError, match=r"landmarks has shape \(68,\)"):
        small_fit((*scene[:2], scene[2][:, 0], scene[3]))


def test_the_residuals_are_the_energy(fitted):
    energy, y, data = fitted.problem(kind="residual")

    @jax.jit
    def sums(y, data):
        value, parts = energy.value(y, data)
        residuals = energy.residual(y, data)
        return value, parts, {name: sum_of_squares(r) for name, r in residuals.items()}

    value, parts, squares = sums(y, data)
    assert set(squares) == set(parts)
    for name, part in parts.items():
        assert float(squares[name]) == pytest.approx(float(part), rel=1e-5, abs=1e-12)
    other = fitted.problem()[0].value(y, data)[0]
    assert float(value) == pytest.approx(float(other), rel=1e-2)
    with pytest.raises(ValueError, match="kind is 'squares'"):
        fitted.problem(kind="squares")


@pytest.mark.slow
def test_a_solver_of_least_squares_finds_the_fit_again(fitted):
    energy, y, data = fitted.problem(kind="residual")
    value = jax.jit(lambda y: energy.value(y, data)[0])
    away = dataclasses.replace(y, identity=y.identity + 0.5, rotation=y.rotation + 0.02)
    found = optx.least_squares(
        energy.residual, optx.LevenbergMarquardt(1e-6, 1e-8), away, data, max_steps=30, throw=False
    ).value
    assert float(value(found)) < 1.02 * float(value(y)) < 0.9 * float(value(away))


def test_frozen_unknowns_do_not_move(scene, fitted):
    frozen = ("identity", "rotation")
    begun = dataclasses.replace(fitted.parameters, identity=jnp.full(5, 0.3))
    held = small_fit(scene, start=begun, freeze=frozen, focal=45.0)
    y = held.parameters
    np.testing.assert_array_equal(y.identity, begun.identity)
    np.testing.assert_array_equal(y.rotation, begun.rotation)
    focal_px = float(jnp.exp(y.log_focal)) * held.working.crop.side
    assert focal_px == pytest.approx(45 / 36 * 96, rel=1e-5)
    assert float(jnp.max(jnp.abs(y.expression - begun.expression))) > 1e-3
    total = held.stats.energies[0]["total"]
    assert float(total[int(held.stats.steps[0])]) < float(total[0])
    known = np.diag(held.posterior.covariance) == 0
    kept = np.diag(held.stats.curvature) == 0
    np.testing.assert_array_equal(known, kept)
    assert known[:5].all() and known[5 + 3 + 4 + 27 :][:3].all() and known[-1] and known.sum() == 9
    energy, free, data = held.problem()
    assert free.identity is None and free.log_focal is None and free.light is not None
    for a, b in zip(*map(jax.tree.leaves, (put_together(free, data.held), y)), strict=True):
        np.testing.assert_array_equal(a, b)
    assert np.isfinite(float(energy.value(free, data)[0]))
