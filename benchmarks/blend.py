"""Blending over the simplex (Saito 2017, equation 2) at the paper's size, beside other solvers.

592 subjects, five layers of 64, 128, 256, 512 and 512 channels, 64 targets: Gram matrices of
varied textures (see texture_grams.py), 1.6 GB in memory-mapped files. The reduction to 592
dimensions is timed apart; the solvers get the reduced problem (blend_peers.py). A row's "excess"
is its objective over the best certified lower bound, less one: every answer is put on the
simplex and measured by the same code, in double precision.

    pip install piqp highspy clarabel scs
"""

import importlib.util
import statistics
import sys
import tempfile
from functools import partial
from pathlib import Path

import blend_peers
import jax
import jax.numpy as jnp
import numpy as np
import texture_grams
from harness import Benchmark, Measurement, timed

from jaxface.solvers.simplex._minimise_on_simplex import minimise_on_simplex
from jaxface.stages.blending import blend, blend_reduced, blend_weights, reduce_database
from jaxface.stages.blending.solve import Reduced

SUBJECTS, TARGETS = 592, 64


def stored(folder: Path, matrices: dict[str, np.ndarray], kind: str) -> dict[str, np.ndarray]:
    """The matrices as memory-mapped files."""
    for name, value in matrices.items():
        np.save(folder / f"{kind}_{name}.npy", value)
    return {name: np.load(folder / f"{kind}_{name}.npy", mmap_mode="r") for name in matrices}


def squeezed(problem: Reduced) -> tuple[np.ndarray, float]:
    """The first target's problem as peers get it: differences of order one, and their scale."""
    points = problem.points - problem.targets[0]
    scale = float(np.linalg.norm(points, axis=-1).sum(axis=-1).max())
    return points / scale, scale


def objective(problem: Reduced, weights: np.ndarray, norm: str) -> float:
    weights = np.maximum(np.asarray(weights, float), 0)
    points = problem.points - problem.targets[0]
    norms = np.linalg.norm(np.tensordot(weights / weights.sum(), points, 1), axis=-1)
    return float(norms.sum() if norm == "frobenius" else (norms**2).sum())


def single(norm: str, target: jax.Array, points: jax.Array) -> tuple[jax.Array, jax.Array]:
    found = minimise_on_simplex(points, target, norm=norm)
    return found.value, found.stats["relative_gap"]


def seldom(bench: Benchmark, name: str, calls: int, function, *args, values=None, **kwargs):
    """What takes seconds, a few times; nothing is compiled, or it is on the first of the calls."""
    times = []
    for _ in range(calls):
        elapsed, result = timed(function, *args, **kwargs)
        times.append(elapsed)
    best, median = min(times), statistics.median(times)
    found = values(result) if values else {}
    bench.record(Measurement(name, best, median, repeats=calls, values=found))
    return result


def measure(bench: Benchmark, norm: str, problem: Reduced) -> None:
    first = Reduced(problem.points, problem.targets[:1])
    exact = blend_reduced(first, norm=norm)
    bound = float(exact.lower_bound[0])

    def excess(weights) -> dict[str, float]:
        return {"excess": objective(first, weights, norm) / bound - 1}

    def ours(answer) -> dict[str, float]:
        return excess(answer.weights[0]) | {
            "certified gap": float(answer.relative_gap[0]),
            "steps": int(answer.steps[0]),
        }

    def solve(**options):
        return blend_reduced(first, norm=norm, **options)

    jax.clear_caches()
    label = "exact eq. 2" if norm == "frobenius" else "squared"
    bench.time(f"{label}, float64", solve, values=ours)
    bench.time(f"{label}, float32 out", solve, dtype="float32", values=ours)
    near = blend_reduced(Reduced(problem.points, problem.targets[:1] * 1.0001), norm=norm)
    bench.time(f"{label}, from a neighbour's weights", solve, start=near.weights[0], values=ours)
    seldom(bench, f"{label}, all points", 2, solve, method="interior_point", values=ours)
    seldom(bench, f"{label}, jaxopt", 2, solve, method="projected_gradient", values=ours)

    gaps = blend_reduced(problem, norm=norm).relative_gap
    singles = blend_reduced(problem, norm=norm, dtype="float32").relative_gap
    with jax.enable_x64(True):
        many = jax.jit(jax.vmap(partial(single, norm), in_axes=(0, None)))
        points, targets = jnp.asarray(problem.points), jnp.asarray(problem.targets)
        first_call, _ = timed(many, targets, points)
        times = [timed(many, targets, points)[0] for _ in range(4)]
    values = {
        "each (ms)": min(times) / TARGETS * 1e3,
        "certified gap": float(gaps.max()),
        "gap in float32": float(singles.max()),
    }
    bench.record(
        Measurement(
            f"{label}, {TARGETS} targets at once",
            min(times),
            statistics.median(times),
            first_call - min(times),
            len(times),
            values=values,
        )
    )

    points, _ = squeezed(first)
    if norm == "squared":
        flat = points.reshape(len(points), -1)
        hessian = flat @ flat.T
        peers = {
            "piqp": partial(blend_peers.piqp, hessian),
            "highspy": partial(blend_peers.highs, hessian),
            "clarabel": partial(blend_peers.clarabel_qp, hessian),
        }
    else:
        peers = {
            "clarabel": partial(blend_peers.clarabel_socp, points),
            "scs": partial(blend_peers.scs_socp, points),
        }
    for name, solve_once in peers.items():
        if importlib.util.find_spec(name) is None:
            print(f"{name} is not installed: left out", file=sys.stderr)
            continue
        first_call, answer = timed(solve_once)  # nothing to compile
        more = 0 if first_call > 10 else 1 if first_call > 2 else 6
        times = [first_call, *(timed(solve_once)[0] for _ in range(more))]
        bench.record(
            Measurement(
                label, min(times), statistics.median(times), None, len(times), name, excess(answer)
            )
        )


def main() -> None:
    peers = ("piqp", "highspy", "clarabel", "scs")
    present = [name for name in peers if importlib.util.find_spec(name)]
    bench = Benchmark("blend", packages=("jax", "jaxlib", "numpy", "scipy", *present))
    with tempfile.TemporaryDirectory() as folder:
        made, goals = texture_grams.problem(SUBJECTS, TARGETS)
        database = stored(Path(folder), made, "database")
        del made
        one = {name: value[0] for name, value in goals.items()}
        for norm, label in (("squared", "squared"), ("frobenius", "exact eq. 2")):
            name = f"{label}, reduction"
            seldom(bench, f"{name}, 1 target", 1, reduce_database, database, one, norm=norm)
            problem = seldom(
                bench, f"{name}, {TARGETS} targets", 1, reduce_database, database, goals, norm=norm
            )
            measure(bench, norm, problem)
        seldom(bench, "exact eq. 2, blend() in all", 1, blend, database, one)

        few, few_goals = texture_grams.problem(100, 1, channels=(64, 128, 256))
        goal = {name: jnp.asarray(value[0]) for name, value in few_goals.items()}
        data = {name: jnp.asarray(value) for name, value in few.items()}
        largest = jax.jit(jax.grad(lambda t, d: jnp.max(blend_weights(d, t)[0])))
        bench.time("gradient in the target, K=100, three layers", largest, goal, data, repeats=5)
    bench.finish()


if __name__ == "__main__":
    main()
