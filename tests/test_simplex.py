"""Solvers on the simplex: known answers, certificates, derivatives."""

import subprocess
import sys
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxface.solvers.jaxopt_import import NOTICE, jaxopt
from jaxface.solvers.simplex._minimise_on_simplex import minimise_on_simplex, solve
from jaxface.solvers.solution import reason

REFERENCES = Path(__file__).parent / "data" / "simplex_references.npz"
NORMS = ("frobenius", "squared")
NAMES = ("outside", "inside one term", "at a vertex", "dependent points")


def value(points, target, weights, norm):
    """The objective in NumPy doubles, of weights divided by their sum."""
    weights = np.asarray(weights, float) / np.sum(np.asarray(weights, float))
    rest = np.einsum("k,klm->lm", weights, np.asarray(points, float) - np.asarray(target, float))
    norms = np.linalg.norm(rest, axis=-1)
    return norms.sum() if norm == "frobenius" else (norms**2).sum()


@pytest.fixture(scope="module")
def references():
    return dict(np.load(REFERENCES))


@pytest.fixture(scope="module")
def large():
    """300 points whose hull does not hold the target; the support has about 30."""
    rng = np.random.default_rng(4)
    spectrum = 0.9 ** np.arange(60)
    points = (rng.normal(size=(300, 2, 60)) + 1.0) * spectrum
    return points, rng.normal(size=(2, 60)) * spectrum


@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("problem", range(4), ids=NAMES)
def test_agrees_with_an_independent_solver(references, problem, norm, x64):
    points, target = references["points"][problem], references["targets"][problem]
    expected = references[f"{norm}_objective"][problem]
    found = minimise_on_simplex(points.astype(float), target.astype(float), norm=norm)
    assert found.converged
    assert found.stats["relative_gap"] <= 1e-10
    np.testing.assert_allclose(found.stats["objective"], expected, rtol=1e-8)
    assert found.stats["lower_bound"] <= expected * (1 + 1e-12)
    if problem != 3:  # of dependent points several weights are best
        np.testing.assert_allclose(found.value, references[f"{norm}_weights"][problem], atol=2e-4)


@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("problem", range(4), ids=NAMES)
def test_single_precision(references, problem, norm):
    points, target = references["points"][problem], references["targets"][problem]
    found = minimise_on_simplex(jnp.asarray(points), jnp.asarray(target), norm=norm)
    stats = found.stats
    assert found.value.dtype == stats["objective"].dtype == jnp.float32
    assert stats["relative_gap"] <= 1e-6
    # of the weights that were returned, measured elsewhere
    actual = value(points, target, found.value, norm)
    np.testing.assert_allclose(stats["objective"], actual, rtol=2e-7)
    assert stats["lower_bound"] <= references[f"{norm}_objective"][problem] * (1 + 1e-9)
    gap = actual - references[f"{norm}_objective"][problem]
    assert gap <= 1e-6 * actual


@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("method", ["working_set", "interior_point"])
def test_recovers_unique_weights_of_a_target_in_the_hull(norm, method, x64):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(20, 2, 30))
    weights = rng.dirichlet(np.ones(20))
    target = np.einsum("k,klm->lm", weights, points)
    found = minimise_on_simplex(points, target, norm=norm, method=method)
    assert found.converged
    np.testing.assert_allclose(found.value, weights, atol=1e-8)
    # Nothing is relative to a zero objective: the gap is small beside a single point's value.
    assert found.stats["gap"] <= 1e-11 * found.stats["scale"]


@pytest.mark.parametrize("norm", NORMS)
def test_target_at_a_vertex(norm, x64):
    points = np.random.default_rng(1).normal(size=(20, 2, 30))
    found = minimise_on_simplex(points, points[11], norm=norm)
    np.testing.assert_allclose(found.value, np.eye(20)[11], atol=1e-9)
    assert found.stats["objective"] <= 1e-11 * found.stats["scale"]


def test_projection_onto_the_standard_simplex(x64):
    # For unit vectors as points the solution is the projection onto the simplex, known in closed
    # form: max(t - tau, 0).
    target = np.array([0.9, 0.5, -0.3, 0.2, 0.4])
    found = minimise_on_simplex(np.eye(5)[:, None], target[None], norm="squared")
    tau = (0.9 + 0.5 + 0.4 - 1) / 3
    np.testing.assert_allclose(found.value, np.maximum(target - tau, 0), atol=1e-9)


@pytest.mark.parametrize("factor", [1e-9, 1e9])
def test_scale_of_the_data_does_not_matter(references, factor, x64):
    points, target = references["points"][0].astype(float), references["targets"][0].astype(float)
    plain = minimise_on_simplex(points, target)
    scaled = minimise_on_simplex(points * factor, target * factor)
    np.testing.assert_allclose(scaled.value, plain.value, atol=1e-8)
    np.testing.assert_allclose(scaled.stats["objective"], plain.stats["objective"] * factor)


def test_one_point_and_equal_points(x64):
    points = np.random.default_rng(2).normal(size=(1, 2, 30))
    target = np.zeros((2, 30))
    one = minimise_on_simplex(points, target)
    assert one.converged and one.value == 1.0
    equal = minimise_on_simplex(np.repeat(points, 3, axis=0), target)
    assert equal.converged
    np.testing.assert_allclose(equal.stats["objective"], one.stats["objective"])


@given(seed=st.integers(0, 2**32 - 1), inside=st.booleans(), norm=st.sampled_from(NORMS))
def test_bound_holds_everywhere(seed, inside, norm):
    rng = np.random.default_rng(seed)
    spread = np.exp(rng.normal(size=(12, 1, 1)))
    points = (rng.normal(size=(12, 2, 6)) * spread + rng.normal()).astype(np.float32)
    target = rng.normal(size=(2, 6)).astype(np.float32)
    if inside:
        target = np.einsum("k,klm->lm", rng.dirichlet(np.ones(12)), points).astype(np.float32)
    stats = minimise_on_simplex(points, target, norm=norm).stats
    bound = float(stats["lower_bound"])
    for weights in (*rng.dirichlet(np.full(12, 0.2), size=20), *np.eye(12)):
        assert bound <= value(points, target, weights, norm) * (1 + 1e-9)
    assert stats["gap"] <= 1e-6 * stats["objective"] or stats["gap"] <= 3e-7 * stats["scale"]


@pytest.mark.parametrize("norm", NORMS)
def test_working_set_agrees_with_all_points_and_starts_warm(large, norm, x64):
    points, target = large
    cold = minimise_on_simplex(points, target, norm=norm)
    whole = minimise_on_simplex(points, target, norm=norm, method="interior_point")
    assert cold.converged and whole.converged
    assert cold.stats["rounds"] > 1
    np.testing.assert_allclose(cold.value, whole.value, atol=1e-6)
    again = minimise_on_simplex(points, target, norm=norm, start=cold.value)
    assert 3 * again.stats["steps"] < cold.stats["steps"]
    shifted = target + 0.01 * np.random.default_rng(0).normal(size=target.shape)
    warm = minimise_on_simplex(points, shifted, norm=norm, start=cold.value)
    fresh = minimise_on_simplex(points, shifted, norm=norm)
    assert warm.stats["steps"] < fresh.stats["steps"]
    np.testing.assert_allclose(warm.value, fresh.value, atol=1e-6)


def test_support_larger_than_the_working_set(x64):
    rng = np.random.default_rng(5)
    points = rng.normal(size=(300, 2, 60)) * 0.1 + 0.0
    points[:, 0, :] = 0.0
    weights = rng.dirichlet(np.ones(300))
    points = np.concatenate([points, rng.normal(size=(300, 2, 140))], axis=2)
    target = np.einsum("k,klm->lm", weights, points)
    target[0] += 0.5
    found = minimise_on_simplex(points, target)
    assert found.converged
    assert np.sum(found.value > 1e-6) > 64


@pytest.mark.parametrize("norm", NORMS)
def test_vmap_is_a_loop(references, norm):
    points = jnp.asarray(references["points"][0])
    targets = jnp.asarray(references["targets"])

    def one(target, points):
        found = minimise_on_simplex(points, target, norm=norm)
        return found.value, found.stats["objective"], found.stats["relative_gap"]

    looped = [one(target, points) for target in targets]
    mapped = jax.jit(jax.vmap(one, in_axes=(0, None)))(targets, points)
    for number, (weights, objective, _) in enumerate(looped):
        np.testing.assert_allclose(mapped[0][number], weights, atol=1e-6)
        np.testing.assert_allclose(mapped[1][number], objective, rtol=1e-6)
    assert np.all(mapped[2] <= 1e-6)


def difference(points, target, dpoints, dtarget, norm, step=1e-5):
    """Central differences of weights and objective, every solve to 1e-13."""
    ends = [
        solve(points + s * dpoints, target + s * dtarget, norm=norm, tolerance=1e-13)
        for s in (step, -step)
    ]
    return [
        (np.asarray(getattr(ends[0], name)) - np.asarray(getattr(ends[1], name))) / (2 * step)
        for name in ("weights", "objective")
    ]


def check_derivative(points, target, norm, rtol=1e-4):
    rng = np.random.default_rng(3)
    dpoints, dtarget = rng.normal(size=points.shape), rng.normal(size=target.shape)

    def both(points, target):
        found = minimise_on_simplex(points, target, norm=norm, tolerance=1e-13)
        return found.value, found.stats["objective"]

    expected = difference(points, target, dpoints, dtarget, norm)
    _, forward = jax.jvp(both, (points, target), (dpoints, dtarget))
    size = np.abs(expected[0]).max()
    np.testing.assert_allclose(forward[0], expected[0], atol=rtol * max(size, 1e-3))
    np.testing.assert_allclose(forward[1], expected[1], rtol=1e-5, atol=1e-7)

    pull = rng.normal(size=len(points))
    _, transpose = jax.vjp(both, points, target)
    gradients = transpose((jnp.asarray(pull), jnp.asarray(0.5)))
    total = np.sum(gradients[0] * dpoints) + np.sum(gradients[1] * dtarget)
    np.testing.assert_allclose(total, pull @ forward[0] + 0.5 * forward[1], rtol=1e-9)
    return expected


@pytest.mark.parametrize("norm", NORMS)
def test_derivative_against_differences(references, norm, x64):
    points, target = references["points"][0].astype(float), references["targets"][0].astype(float)
    weights, _ = check_derivative(points, target, norm)
    assert np.abs(weights).max() > 1e-2


def test_derivative_where_a_term_vanishes_and_stays_zero(references, x64):
    # The first term of this problem has three dimensions, fewer than the support: its residual
    # is zero, and zero nearby.
    points, target = references["points"][1].astype(float), references["targets"][1].astype(float)
    found = minimise_on_simplex(points, target, tolerance=1e-13)
    assert found.stats["norms"][0] <= 1e-9
    rng = np.random.default_rng(6)
    dtarget = rng.normal(size=target.shape)
    dtarget[0, 3:] = 0.0  # stays within the three dimensions

    def weights(target):
        return minimise_on_simplex(points, target, tolerance=1e-13).value

    expected = difference(points, target, np.zeros_like(points), dtarget, "frobenius")[0]
    _, forward = jax.jvp(weights, (target,), (dtarget,))
    np.testing.assert_allclose(forward, expected, atol=1e-3 * np.abs(expected).max())


def test_derivative_at_a_vertex_is_zero(references, x64):
    points, target = references["points"][2].astype(float), references["targets"][2].astype(float)
    target = points[7] + 3.0 * (target - points[7])
    jacobian = jax.jacrev(lambda t: minimise_on_simplex(points, t).value)(jnp.asarray(target))
    assert minimise_on_simplex(points, target).value[7] == 1.0
    assert np.all(jacobian == 0.0)


@pytest.mark.parametrize("norm", NORMS)
def test_derivative_is_finite_where_there_is_none(references, norm, x64):
    dependent = references["points"][3].astype(float), references["targets"][3].astype(float)
    on_target = references["points"][0].astype(float), references["points"][0, 3].astype(float)
    for points, target in (dependent, on_target):

        def spread(points, target):
            found = minimise_on_simplex(points, target, norm=norm)
            return jnp.sum(found.value**2) + found.stats["objective"]

        gradients = jax.grad(spread, argnums=(0, 1))(jnp.asarray(points), jnp.asarray(target))
        assert all(np.all(np.isfinite(g)) for g in gradients)


def test_gradient_in_single_precision_and_under_vmap(references):
    points = jnp.asarray(references["points"][0])
    targets = jnp.asarray(references["targets"][[0, 3]])

    def largest(target):
        return jnp.max(minimise_on_simplex(points, target).value)

    mapped = jax.jit(jax.vmap(jax.grad(largest)))(targets)
    assert mapped.dtype == jnp.float32
    with jax.enable_x64(True):
        exact = jax.grad(
            lambda t: jnp.max(minimise_on_simplex(references["points"][0].astype(float), t).value)
        )(jnp.asarray(references["targets"][0], jnp.float64))
    np.testing.assert_allclose(mapped[0], exact, atol=2e-3 * np.abs(exact).max())


def lattice(seed):
    """Three points in five terms of two dimensions, on a grid: terms often vanish at the solution,
    with all weights positive, where full primal-dual steps go round in circles."""
    rng = np.random.default_rng(seed)
    return np.round(2 * rng.normal(size=(3, 5, 2))), np.round(2 * rng.normal(size=(5, 2)))


def small_problems(rng, count, shape):
    """Random problems of one shape: in the hull, at a point, doubled points, ties, any scale."""
    k, terms, m = shape
    for number in range(count):
        points, target = rng.normal(size=shape), rng.normal(size=shape[1:])
        points *= np.exp(rng.normal(size=(k, 1, 1)))
        match number % 8:
            case 0:
                target = np.einsum("k,klm->lm", rng.dirichlet(np.ones(k)), points)
            case 1:
                target = points[rng.integers(k)]
            case 2:
                points = points[rng.integers(0, max(1, k // 2), size=k)]
            case 3:
                points = points[:1] + rng.normal(size=(k, 1, 1)) * rng.normal(size=(1, terms, m))
            case 4:
                points, target = np.round(2 * points), np.round(2 * target)
            case 5:
                target[0] = np.einsum("k,km->m", rng.dirichlet(np.ones(k)), points[:, 0])
            case 6:
                points[:, 0], target[0] = 0.0, rng.integers(0, 2)
        scale = 10.0 ** rng.integers(-9, 10)
        yield points * scale, target * scale


@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("shape", [(3, 5, 2), (6, 3, 3)], ids=str)
def test_small_problems_converge_or_say_why(shape, norm, x64):
    """A hundred of each; the certificate is that of independent arithmetic."""
    made = [*small_problems(np.random.default_rng(8), 100, shape)]
    points, targets = (np.stack(x) for x in zip(*made, strict=True))

    @jax.jit
    def all_of(points, targets):
        return jax.lax.map(lambda data: solve(*data, norm=norm), (points, targets))

    answers = all_of(points, targets)
    assert np.all(answers.converged), answers.relative_gap[~np.asarray(answers.converged)]
    for number, (p, t) in enumerate(made):
        found = value(p, t, answers.weights[number], norm)
        zero = 1e-11 * float(answers.scale[number])
        np.testing.assert_allclose(answers.objective[number], found, rtol=1e-9, atol=zero)
        assert answers.lower_bound[number] <= found * (1 + 1e-9) + zero


@pytest.mark.parametrize("seed", [22, 233, 341])
def test_terms_that_vanish_inside_the_simplex(seed, x64):
    points, target = lattice(seed)
    found = minimise_on_simplex(points, target)
    assert found.converged, reason(found)
    assert found.stats["relative_gap"] <= 1e-11


def test_what_does_not_converge_says_how_far_it_came(references, x64):
    points, target = references["points"][0].astype(float), references["targets"][0].astype(float)
    found = minimise_on_simplex(points, target, norm="squared", method="projected_gradient")
    assert not found.converged
    assert reason(found).startswith("used all its steps; the certified gap is")
    with jax.debug_nans(False):
        points[2, 0, 0] = np.nan
        broken = minimise_on_simplex(points, target)
        assert not broken.converged and "not finite" in reason(broken)


def test_derivative_with_more_positive_weights_than_are_usual(x64):
    """Unit vectors: the projection onto the simplex, whose derivative is a centred identity."""
    count = 300
    target = np.full(count, 1.0 / count) + 1e-4 * np.random.default_rng(2).normal(size=count)
    points, change = np.eye(count)[:, None], np.random.default_rng(3).normal(size=count)

    def weights(target):
        return minimise_on_simplex(points, target[None], norm="squared").value

    found, forward = jax.jvp(weights, (jnp.asarray(target),), (change,))
    assert np.sum(found > 0) == count
    np.testing.assert_allclose(forward, change - change.mean(), atol=1e-8)


def test_projected_gradient_certifies_what_it_reached(references, x64):
    points, target = references["points"][0].astype(float), references["targets"][0].astype(float)
    found = minimise_on_simplex(points, target, norm="squared", method="projected_gradient")
    best = references["squared_objective"][0]
    assert found.stats["lower_bound"] <= best <= found.stats["objective"] * (1 + 1e-9)
    assert found.stats["objective"] <= 1.05 * best


def test_jaxopt_still_works_and_only_its_notice_is_silenced():
    # A process of its own: jaxopt speaks once, on its first import.
    code = (
        "import warnings; warnings.simplefilter('error');"
        "from jaxface.solvers.jaxopt_import import jaxopt;"
        "assert jaxopt().ProjectedGradient"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 0, f"jaxopt no longer imports silently:\n{run.stderr[-2000:]}"
    source = Path(str(jaxopt().__file__)).read_text("utf-8")
    assert NOTICE in source, "jaxopt's notice has changed: the filter for it may go"


def test_other_warnings_of_jaxopt_are_heard(monkeypatch):
    def imported(name):
        warnings.warn("something else", DeprecationWarning, stacklevel=1)
        warnings.warn(f"{NOTICE}. Really.", DeprecationWarning, stacklevel=1)

    monkeypatch.setattr("importlib.import_module", imported)
    with pytest.warns(DeprecationWarning) as heard:
        jaxopt()
    assert [str(w.message) for w in heard] == ["something else"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"norm": "l1"}, "norm is 'l1'"),
        ({"method": "guess"}, "method is 'guess'"),
        ({"points": np.zeros((4, 6))}, r"points has shape \(4, 6\)"),
        ({"target": np.zeros((2, 5))}, r"target has shape \(2, 5\)"),
        ({"start": np.ones(3)}, r"start has shape \(3,\)"),
    ],
)
def test_errors_name_the_argument(change, message):
    given = {"points": np.zeros((4, 2, 6)), "target": np.zeros((2, 6))} | change
    with pytest.raises(ValueError, match=message):
        minimise_on_simplex(**given)
