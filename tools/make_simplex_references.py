"""Reference answers of blending problems, by an independent solver (Clarabel through CVXPY).

    pip install cvxpy clarabel
    python tools/make_simplex_references.py      # writes tests/data/simplex_references.npz

Four problems of 40 points in three terms of 30 numbers, points correlated as statistics of textures
are: target outside the hull; inside in one term only; at a vertex and a little off it; and
dependent points. Stored: points and targets in single precision (taken as exact), and of both norms
the objective and the weights.
"""

from pathlib import Path

import numpy as np

FILE = Path(__file__).parent.parent / "tests" / "data" / "simplex_references.npz"


def problems() -> tuple[np.ndarray, np.ndarray]:
    """Points (4, 40, 3, 30) and targets (4, 3, 30), float32."""
    rng = np.random.default_rng(2017)
    spectrum = 0.75 ** np.arange(30)
    points = rng.normal(size=(4, 40, 3, 30)) * spectrum + 2.0 * spectrum
    points[3, 20:] = points[3, :20]
    points[1, :, 0, 3:] = 0.0
    points = points.astype(np.float32)
    targets = points.mean(axis=1, dtype=np.float64) + 0.7 * rng.normal(size=(4, 3, 30)) * spectrum
    targets[1, 0] = points[1, :5, 0].mean(axis=0, dtype=np.float64)
    outwards = points[2, 7] - points[2].mean(axis=0)
    targets[2] = points[2, 7] + 0.5 * outwards
    return points, targets.astype(np.float32)


def main() -> None:
    import cvxpy as cp

    points, targets = problems()
    stored: dict[str, np.ndarray] = {"points": points, "targets": targets}
    for norm in ("frobenius", "squared"):
        objectives, weights = [], []
        for p, t in zip(points.astype(float), targets.astype(float), strict=True):
            w = cp.Variable(len(p), nonneg=True)
            rests = [(p[:, i] - t[i]).T @ w for i in range(p.shape[1])]
            measure = cp.norm if norm == "frobenius" else cp.sum_squares
            problem = cp.Problem(cp.Minimize(sum(map(measure, rests))), [cp.sum(w) == 1])
            problem.solve(solver=cp.CLARABEL, tol_gap_abs=1e-12, tol_gap_rel=1e-12, tol_feas=1e-12)
            value = np.maximum(w.value, 0) / np.maximum(w.value, 0).sum()
            norms = np.linalg.norm(np.einsum("k,klm->lm", value, p) - t, axis=-1)
            objectives.append(norms.sum() if norm == "frobenius" else (norms**2).sum())
            weights.append(value)
            print(norm, problem.status, objectives[-1], (value > 1e-6).sum())
        stored[f"{norm}_objective"] = np.array(objectives)
        stored[f"{norm}_weights"] = np.array(weights, np.float32)
    np.savez_compressed(FILE, **stored)
    print(FILE.name, FILE.stat().st_size, "bytes")


if __name__ == "__main__":
    main()
