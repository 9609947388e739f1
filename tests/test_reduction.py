"""Long columns to short ones: distances stay."""

from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxface.solvers.simplex import reduction
from jaxface.solvers.simplex.reduction import _turned, reduced, triangular_factor


def block_reader(matrix, rows):
    """Blocks of ``rows`` rows; a sample is rows at equal distances."""

    def blocks(sample):
        stride = 1 if sample is None else max(1, len(matrix) // sample)
        chosen = matrix[::stride] * stride**0.5
        for first in range(0, len(chosen), rows):
            yield np.array(chosen[first : first + rows].T, np.float64, order="C")

    return blocks


def columns(kind):
    rng = np.random.default_rng(0)
    matrix = rng.normal(size=(2000, 12))
    if kind == "ill-conditioned":
        turn = np.linalg.qr(rng.normal(size=(12, 12)))[0]
        matrix = matrix @ turn @ np.diag(10.0 ** -np.arange(12)) @ turn.T
    elif kind == "dependent":
        matrix[:, 6:] = matrix[:, :6]
    elif kind == "misleading sample":
        matrix *= 1e-3
        matrix[5::50] += 1e3 * rng.normal(size=(40, 12))
    elif kind == "zero":
        matrix[:, 3] = 0.0
    elif kind == "few long":
        turn = np.linalg.qr(rng.normal(size=(12, 12)))[0]
        matrix = matrix @ turn @ np.diag([1e5, 1e4] + 10 * [1.0]) @ turn.T
    elif kind == "few long, misleading":
        turn = np.linalg.qr(rng.normal(size=(12, 12)))[0]
        matrix = matrix @ turn @ np.diag([1e5, 1e4] + 10 * [1.0]) @ turn.T
        matrix[5::50] += 1e7 * rng.normal(size=(40, 12))
    elif kind == "short":
        matrix = matrix[:7]
    return matrix


KINDS = (
    "plain",
    "ill-conditioned",
    "dependent",
    "misleading sample",
    "few long",
    "few long, misleading",
    "zero",
    "short",
)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rows", [97, 5000])
def test_triangular_factor_keeps_lengths(kind, rows):
    matrix = columns(kind)
    factor = triangular_factor(block_reader(matrix, rows), 12)
    assert factor.shape == (12, 12)
    rng = np.random.default_rng(1)
    combinations = np.vstack([rng.normal(size=(50, 12)), np.linalg.svd(matrix)[2]])
    exact = np.linalg.norm(combinations @ matrix.T, axis=1)
    found = np.linalg.norm(combinations @ factor.T, axis=1)
    # Backward stable: also short combinations are right to the rounding of the long ones.
    size = float(np.linalg.norm(matrix))
    np.testing.assert_allclose(found, exact, rtol=1e-9, atol=1e-13 * size)


def test_few_long_directions_are_turned_not_divided():
    sample = next(iter(block_reader(columns("few long"), 5000)(None)))
    form = _turned(sample @ sample.T)
    assert form is not None
    assert form.reflectors.shape == (12, 2)
    orthogonal = np.eye(12) - form.returns @ form.reflectors.T
    np.testing.assert_allclose(orthogonal @ orthogonal.T, np.eye(12), atol=1e-14)
    lengths = np.linalg.norm(form.evened(sample), axis=1)
    np.testing.assert_allclose(lengths[:2] / form.scales[:2], 1.0, rtol=1e-6)
    assert np.all(lengths[2:] < 2 * form.scales[2:])
    assert _turned(np.eye(12)) is None


def test_threads_change_no_digit(monkeypatch):
    found, asked = [], []

    def executor(threads):
        asked.append(threads)
        return ThreadPoolExecutor(threads)

    monkeypatch.setattr(reduction, "ThreadPoolExecutor", executor)
    for threads in (1, 3):
        monkeypatch.setattr(reduction, "usable_cores", lambda threads=threads: threads)
        found.append(triangular_factor(block_reader(columns("few long"), 97), 12))
    assert sorted(set(asked)) == [1, 3]
    np.testing.assert_array_equal(*found)


def test_triangular_factor_refuses_nan():
    matrix = columns("plain")
    matrix[100, 3] = np.nan
    with pytest.raises(ValueError, match="NaN or infinite"):
        triangular_factor(block_reader(matrix, 97), 12)


@pytest.mark.parametrize("kind", ["plain", "ill-conditioned", "dependent", "short"])
def test_reduced_keeps_distances(kind, x64):
    matrix = columns(kind).T  # (12, 2000)
    targets = np.random.default_rng(2).normal(size=(3, matrix.shape[1])) + matrix[0]
    short, goals = jax.vmap(reduced, in_axes=(None, 0), out_axes=(None, 0))(
        jnp.asarray(matrix), jnp.asarray(targets)
    )
    assert short.shape[1] == goals.shape[1] <= 13
    weights = np.random.default_rng(3).dirichlet(np.ones(12), size=20)
    for target, goal in zip(targets, goals, strict=True):
        exact = np.linalg.norm(weights @ matrix - target, axis=1)
        found = np.linalg.norm(weights @ short - goal, axis=1)
        np.testing.assert_allclose(found, exact, rtol=1e-11)
