"""Many targets over the same points: the faces' Newton method, and what is left of it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxface.solvers.simplex._minimise_on_simplex import minimise_on_simplex, solve
from jaxface.solvers.simplex.faces import SLOTS, Products, newton_on_faces
from jaxface.stages.blending import blend_reduced
from jaxface.stages.blending.solve import Reduced

NORMS = ("frobenius", "squared")
OUTSIDE = 7


@pytest.fixture(scope="module")
def problem():
    """200 points; targets outside the hull, then in it, at a point, and inside in one term."""
    rng = np.random.default_rng(4)
    spectrum = 0.9 ** np.arange(60)
    points = (rng.normal(size=(200, 2, 60)) + 1.0) * spectrum
    targets = rng.normal(size=(OUTSIDE + 3, 2, 60)) * spectrum
    few = np.zeros(200)
    few[:5] = rng.dirichlet(np.ones(5))
    targets[OUTSIDE] = np.einsum("k,klm->lm", few, points)
    targets[OUTSIDE + 1] = points[17]
    targets[OUTSIDE + 2, 0] = np.einsum("k,km->m", few, points[:, 0])
    return points, targets


def test_many_targets_agree_with_one_by_one(problem, x64):
    points, targets = problem
    norm = "frobenius"
    alone = [solve(points, target, norm=norm) for target in targets]
    found = jax.jit(jax.vmap(lambda p, t: minimise_on_simplex(p, t, norm=norm), in_axes=(None, 0)))(
        points, targets
    )
    stats = found.stats
    assert np.all(found.converged)
    # Faces were enough where no residual vanishes.
    assert np.all(stats["rounds"][:OUTSIDE] == 1)
    assert np.all(stats["relative_gap"][:OUTSIDE] <= 1e-11)
    for number, one in enumerate(alone):
        np.testing.assert_allclose(found.value[number], one.weights, atol=1e-6)
        zero = 1e-11 * float(one.scale)
        np.testing.assert_allclose(stats["objective"][number], one.objective, rtol=1e-10, atol=zero)
        assert stats["lower_bound"][number] <= one.objective * (1 + 1e-12) + zero
        np.testing.assert_allclose(stats["scale"][number], one.scale, rtol=1e-9)
        np.testing.assert_allclose(stats["norms"][number], one.norms, rtol=1e-7, atol=zero**0.5)


@pytest.mark.parametrize("norm", NORMS)
def test_objectives_of_many_are_those_of_the_points(problem, norm, x64):
    points, targets = problem
    if norm == "squared":
        points, targets = points[:, :1], targets[:, :1]
    answer = blend_reduced(Reduced(points, targets), norm=norm)
    assert np.all(answer.relative_gap[:OUTSIDE] <= 1e-11)
    for number, target in enumerate(targets):
        w = answer.weights[number] / answer.weights[number].sum()
        norms = np.linalg.norm(np.tensordot(w, points - target, 1), axis=-1)
        value = norms.sum() if norm == "frobenius" else (norms**2).sum()
        np.testing.assert_allclose(answer.objective[number], value, rtol=1e-9, atol=1e-12)
        # the bound, from the returned dual vectors
        dual = answer.dual[number]
        assert np.all(np.linalg.norm(dual, axis=-1) <= 1 + 1e-12)
        bound = max(np.einsum("lm,klm->k", dual, points - target).min(), 0.0)
        bound = bound if norm == "frobenius" else bound**2
        assert answer.lower_bound[number] <= bound + 1e-11 * answer.scale[number]


def test_many_in_single_precision_and_from_a_start(problem):
    points, targets = problem
    cold = blend_reduced(Reduced(points, targets[:OUTSIDE].repeat(2, axis=0)), dtype="float32")
    assert cold.weights.dtype == np.float32
    assert np.all(cold.relative_gap <= 1e-6)
    again = blend_reduced(
        Reduced(points, targets[:OUTSIDE].repeat(2, axis=0)), start=cold.weights, dtype="float32"
    )
    assert 3 * again.steps.sum() < cold.steps.sum()
    np.testing.assert_allclose(again.weights, cold.weights, atol=1e-6)


def test_faces_project_onto_the_standard_simplex(x64):
    # Known in closed form: max(t - tau, 0).
    count = SLOTS + 16
    target = np.random.default_rng(0).normal(size=count)
    ranked = np.sort(target)[::-1]
    taus = (np.cumsum(ranked) - 1) / np.arange(1, count + 1)
    tau = taus[np.sum(ranked > taus) - 1]
    problem = Products(
        jnp.eye(count)[None], jnp.asarray(target)[None], jnp.asarray([target @ target])
    )
    start = jnp.full(count, 1.0 / count)
    weights, steps = jax.jit(newton_on_faces)(problem, start, jnp.asarray(1e-12))
    np.testing.assert_allclose(weights, np.maximum(target - tau, 0), atol=1e-12)
    assert steps < 3 * np.sum(target > tau)


def test_faces_give_up_beyond_their_slots(x64):
    # The solution has all the points; what is returned is on the simplex all the same.
    count = 2 * SLOTS
    problem = Products(jnp.eye(count)[None], jnp.zeros((1, count)), jnp.zeros(1))
    start = jnp.full(count, 1.0 / count)
    weights, _ = jax.jit(newton_on_faces)(problem, start, jnp.asarray(1e-12))
    assert np.sum(weights > 0) <= SLOTS
    np.testing.assert_allclose(np.sum(weights), 1.0)
