"""Blending Gram matrices (Saito 2017, equation 2): the stage, its baselines, its gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxface.stages.blending import (
    blend,
    blend_reduced,
    blend_weights,
    blended_grams,
    nearest_subject,
    reduce_database,
    unconstrained,
)
from jaxface.stages.blending.columns import blocks

NORMS = ("frobenius", "squared")
SIZES = {"conv1_1": 8, "conv2_1": 12}


def grams(count, seed, dtype=np.float32):
    """Gram matrices of correlated responses: what many textures have in common, and a little."""
    rng = np.random.default_rng(seed)
    common = np.random.default_rng(99)
    found = {}
    for name, n in SIZES.items():
        mixing = common.normal(size=(n, n))
        responses = np.maximum(rng.normal(size=(count, 3 * n, n)) @ mixing + 0.5, 0)
        found[name] = (responses.transpose(0, 2, 1) @ responses / (3 * n)).astype(dtype)
    return found


def objective(database, target, weights, norm, factors=None):
    """Equation 2 as it is written, in doubles."""
    total = 0.0
    weights = np.asarray(weights, float)
    for name, value in database.items():
        rest = np.tensordot(weights, np.asarray(value, float), 1) - np.asarray(target[name], float)
        length = np.linalg.norm(rest)
        total += (factors or {}).get(name, 1.0) * (length if norm == "frobenius" else length**2)
    return total


@pytest.fixture(scope="module")
def problem():
    database = grams(25, 0)
    target = {name: value[0] for name, value in grams(1, 1).items()}
    return database, target


@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("factors", [None, {"conv1_1": 4.0}])
def test_blend_of_single_precision(problem, norm, factors):
    database, target = problem
    found = blend(database, target, norm=norm, weights=factors)
    assert found.weights.dtype == np.float32 and found.stats["converged"]
    assert found.relative_gap <= 1e-6
    shares = found.weights.astype(float) / found.weights.astype(float).sum()
    actual = objective(database, target, shares, norm, factors)
    np.testing.assert_allclose(found.objective, actual, rtol=3e-7)
    for name in SIZES:
        rest = np.tensordot(shares, database[name].astype(float), 1) - target[name]
        np.testing.assert_allclose(found.residuals[name], np.linalg.norm(rest), rtol=1e-9)
    rng = np.random.default_rng(2)
    for weights in (*rng.dirichlet(np.full(25, 0.3), size=30), *np.eye(25)):
        assert found.lower_bound <= objective(database, target, weights, norm, factors)


@pytest.mark.parametrize("norm", NORMS)
def test_blend_of_double_precision(norm):
    database = grams(25, 0, np.float64)
    target = {name: value[0] for name, value in grams(1, 1, np.float64).items()}
    found = blend(database, target, norm=norm)
    assert found.weights.dtype == np.float64
    assert found.relative_gap <= 1e-10
    np.testing.assert_allclose(
        found.objective, objective(database, target, found.weights, norm), rtol=1e-10
    )


def test_target_in_the_hull_gives_its_weights(problem):
    database, _ = problem
    true = np.random.default_rng(3).dirichlet(np.full(25, 0.5))
    exact = {name: value.astype(float) for name, value in database.items()}
    found = blend(exact, blended_grams(exact, true))
    np.testing.assert_allclose(found.weights, true, atol=1e-9)
    assert found.gap <= 1e-11 * found.stats["scale"]


def test_several_targets_memory_mapped_in_blocks(problem, tmp_path, monkeypatch):
    database, _ = problem
    targets = grams(3, 4)
    stored = {}
    for name, value in database.items():
        np.save(tmp_path / f"{name}.npy", value)
        stored[name] = np.load(tmp_path / f"{name}.npy", mmap_mode="r")
    monkeypatch.setattr("jaxface.stages.blending.columns.BLOCK_BYTES", 8 * 28 * 20)
    monkeypatch.setattr("jaxface.stages.blending.mixing.BLOCK_BYTES", 8 * 144 * 2)
    together = blend(stored, targets)
    assert together.weights.shape == (3, 25)
    for number in range(3):
        alone = blend(database, {name: value[number] for name, value in targets.items()})
        np.testing.assert_allclose(together.weights[number], alone.weights, atol=1e-6)
        np.testing.assert_allclose(together.objective[number], alone.objective, rtol=1e-6)
        for name in SIZES:
            np.testing.assert_allclose(
                together.residuals[name][number], alone.residuals[name], rtol=1e-6
            )
    mixed = blended_grams(stored, together.weights[0])
    for name, value in database.items():
        expected = np.tensordot(together.weights[0], value, 1)
        assert mixed[name].dtype == np.float32
        np.testing.assert_allclose(mixed[name], expected, rtol=1e-5)


@pytest.mark.parametrize("sample", [None, 10])
def test_blocks_have_the_matrices_length(problem, sample, monkeypatch):
    database, _ = problem
    stack = database["conv2_1"]
    monkeypatch.setattr("jaxface.stages.blending.columns.BLOCK_BYTES", 8 * 25 * 12)
    read = list(blocks((stack[:10], stack[10:]), 2.0, sample))
    assert len(read) > 1 and all(block.dtype == np.float64 for block in read)
    squares = sum(np.sum(block**2, axis=1) for block in read)
    exact = 4 * np.sum(stack.astype(float) ** 2, axis=(1, 2))
    if sample is None:
        np.testing.assert_allclose(squares, exact, rtol=1e-6)
    else:
        assert sum(block.shape[1] for block in read) < 78 / 2
        assert np.all((squares > exact / 4) & (squares < exact * 4))


def test_warm_start_and_a_reduced_problem(problem):
    database, target = problem
    small = reduce_database(database, target)
    assert small.points.shape == (25, 2, 26)
    cold = blend_reduced(small)
    warm = blend_reduced(small, start=cold.weights)
    assert np.all(warm.steps <= cold.steps)
    np.testing.assert_allclose(warm.objective, cold.objective, rtol=1e-9)


def test_nearest_subject(problem):
    database, target = problem
    for norm in NORMS:
        found = nearest_subject(database, target, norm=norm, weights={"conv2_1": 0.5})
        factors = {"conv2_1": 0.5}
        every = np.array([objective(database, target, w, norm, factors) for w in np.eye(25)])
        np.testing.assert_allclose(found.stats["objectives"], every, rtol=1e-9)
        assert np.argmax(found.weights) == np.argmin(every) and found.weights.sum() == 1
        np.testing.assert_allclose(found.objective, min(every), rtol=1e-9)


def test_unconstrained_is_least_squares_with_the_shortest_weights(problem):
    database, target = problem
    doubled = {name: np.concatenate([value, value]) for name, value in database.items()}
    found = unconstrained(doubled, target, norm="squared")
    columns = np.concatenate([v.reshape(50, -1) for v in doubled.values()], axis=1).astype(float)
    goal = np.concatenate([v.reshape(-1) for v in target.values()]).astype(float)
    expected = np.linalg.lstsq(columns.T, goal, rcond=1e-10)[0]
    np.testing.assert_allclose(found.weights, expected, atol=1e-7)
    np.testing.assert_allclose(found.objective, np.sum((columns.T @ expected - goal) ** 2))
    constrained = blend(doubled, target, norm="squared")
    nearest = nearest_subject(doubled, target, norm="squared")
    assert found.objective < constrained.objective < nearest.objective


@pytest.mark.parametrize("norm", NORMS)
def test_weights_in_memory_agree_with_the_stage(problem, norm):
    database, target = problem
    stage = blend(database, target, norm=norm, weights={"conv1_1": 3.0})
    weights, value = blend_weights(database, target, norm=norm, weights={"conv1_1": 3.0})
    assert weights.dtype == jnp.float32
    np.testing.assert_allclose(weights, stage.weights, atol=1e-6)
    np.testing.assert_allclose(value, stage.objective, rtol=1e-6)
    targets = grams(2, 4)
    mapped = jax.jit(jax.vmap(lambda t: blend_weights(database, t, norm=norm)[0]))(targets)
    expected = blend(database, targets, norm=norm).weights
    np.testing.assert_allclose(mapped, expected, atol=2e-6)


@pytest.mark.parametrize("norm", NORMS)
def test_gradient_against_differences(norm, x64):
    database = grams(25, 0, np.float64)
    target = {name: value[0] for name, value in grams(1, 1, np.float64).items()}
    factors = {"conv1_1": jnp.asarray(2.0), "conv2_1": jnp.asarray(0.7)}
    pull = np.random.default_rng(5).normal(size=25)

    def loss(database, target, factors):
        weights, value = blend_weights(
            database, target, norm=norm, weights=factors, tolerance=1e-13
        )
        return pull @ weights + 0.1 * value

    rng = np.random.default_rng(6)
    at = jax.tree.map(jnp.asarray, (database, target, factors))

    def symmetric(x):
        change = rng.normal(size=x.shape)
        return jnp.asarray(change + np.swapaxes(change, -1, -2) if x.ndim > 1 else change)

    along = jax.tree.map(symmetric, at)
    step = 1e-5
    ahead = loss(*jax.tree.map(lambda x, d: x + step * d, at, along))
    behind = loss(*jax.tree.map(lambda x, d: x - step * d, at, along))
    expected = (ahead - behind) / (2 * step)
    _, forward = jax.jvp(loss, at, along)
    gradients = jax.jit(jax.grad(loss, argnums=(0, 1, 2)))(*at)
    reverse = sum(
        jnp.sum(g * d)
        for g, d in zip(jax.tree.leaves(gradients), jax.tree.leaves(along), strict=True)
    )
    np.testing.assert_allclose(forward, expected, rtol=1e-4)
    np.testing.assert_allclose(reverse, forward, rtol=1e-8)


def test_a_gradient_through_the_blended_matrices(problem):
    database, target = problem

    def loss(target):
        weights, _ = blend_weights(database, target)
        return jnp.sum(blended_grams(database, weights)["conv2_1"] ** 2)

    gradient = jax.grad(loss)(jax.tree.map(jnp.asarray, target))
    assert all(np.all(np.isfinite(g)) and np.any(g) for g in gradient.values())


def broken(database, target, kind):
    database, target = dict(database), dict(target)
    options = {}
    if kind == "nan in the database":
        database["conv2_1"] = database["conv2_1"].copy()
        database["conv2_1"][7, 2, 2] = np.nan
    elif kind == "nan in the target":
        target["conv1_1"] = np.full_like(target["conv1_1"], np.inf)
    elif kind == "other number of subjects":
        database["conv2_1"] = database["conv2_1"][:20]
    elif kind == "other size":
        target["conv2_1"] = target["conv1_1"]
    elif kind == "missing layer":
        del target["conv2_1"]
    elif kind == "one subject":
        database = {name: value[:1] for name, value in database.items()}
    elif kind == "equal subjects":
        database = {name: np.repeat(value[:1], 5, axis=0) for name, value in database.items()}
    elif kind == "no layers":
        database = {}
    elif kind == "not square":
        database["conv1_1"] = database["conv1_1"][:, :3]
    elif kind == "unknown layer's weight":
        options["weights"] = {"conv9": 1.0}
    elif kind == "negative weight":
        options["weights"] = {"conv1_1": -1.0}
    elif kind == "unknown norm":
        options["norm"] = "nuclear"
    return database, target, options


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("nan in the database", "'conv2_1' of subject 7 holds NaN"),
        ("nan in the target", "'conv1_1' of target 0 holds NaN"),
        ("other number of subjects", "different numbers of subjects"),
        ("other size", "'conv2_1' of the target has shape"),
        ("missing layer", "they must be the same"),
        ("one subject", "has 1 subject"),
        ("equal subjects", "all 5 subjects of the database have the same"),
        ("no layers", "no layers"),
        ("not square", "'conv1_1' of the database has shape"),
        ("unknown layer's weight", "weights has a layer 'conv9'"),
        ("negative weight", "must be positive"),
        ("unknown norm", "norm is 'nuclear'"),
    ],
)
def test_errors_say_what_is_wrong(problem, kind, message):
    database, target, options = broken(problem[0], problem[1], kind)
    with pytest.raises(ValueError, match=message):
        blend(database, target, **options)
