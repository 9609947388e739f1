"""The reduced blending problems in other solvers' words. Each function solves once.

``points`` is (k, m) for the quadratic programme ``min ||w^T points||^2``, (k, l, m) for the cone
problem ``min sum_l ||w^T points_l||``; both over the simplex. The solvers get what jaxface's get,
the reduced problem, scaled to order one; those of quadratic programmes also its Hessian for
nothing.
"""

import numpy as np
from scipy import sparse


def piqp(hessian: np.ndarray) -> np.ndarray:
    import piqp

    k = len(hessian)
    solver = piqp.DenseSolver()
    solver.settings.eps_abs = 1e-10
    solver.settings.eps_rel = 1e-10
    solver.setup(
        hessian, np.zeros(k), np.ones((1, k)), np.ones(1), x_l=np.zeros(k), x_u=np.full(k, np.inf)
    )
    solver.solve()
    return np.asarray(solver.result.x)


def highs(hessian: np.ndarray) -> np.ndarray:
    import highspy

    k = len(hessian)
    solver = highspy.Highs()
    solver.setOptionValue("output_flag", False)
    lp = highspy.HighsLp()
    lp.num_col_, lp.num_row_ = k, 1
    lp.col_cost_ = np.zeros(k)
    lp.col_lower_, lp.col_upper_ = np.zeros(k), np.full(k, highspy.kHighsInf)
    lp.row_lower_ = lp.row_upper_ = np.ones(1)
    lp.a_matrix_.format_ = highspy.MatrixFormat.kRowwise
    lp.a_matrix_.start_ = np.array([0, k])
    lp.a_matrix_.index_ = np.arange(k)
    lp.a_matrix_.value_ = np.ones(k)
    lower = sparse.csc_matrix(np.tril(hessian))
    quadratic = highspy.HighsHessian()
    quadratic.dim_ = k
    quadratic.format_ = highspy.HessianFormat.kTriangular
    quadratic.start_, quadratic.index_ = lower.indptr, lower.indices
    quadratic.value_ = lower.data
    solver.passModel(lp)
    solver.passHessian(quadratic)
    solver.run()
    return np.asarray(solver.getSolution().col_value)


def clarabel_qp(hessian: np.ndarray) -> np.ndarray:
    import clarabel

    k = len(hessian)
    rows = sparse.vstack([np.ones((1, k)), -sparse.eye(k)], format="csc")
    cones = [clarabel.ZeroConeT(1), clarabel.NonnegativeConeT(k)]
    return _clarabel(
        sparse.csc_matrix(np.triu(hessian)), np.zeros(k), rows, np.eye(1, k + 1)[0], cones
    )


def clarabel_socp(points: np.ndarray) -> np.ndarray:
    import clarabel

    c, rows, b, sizes = _cones(points)
    k, terms = points.shape[:2]
    cones = [clarabel.ZeroConeT(1), clarabel.NonnegativeConeT(k)]
    cones += [clarabel.SecondOrderConeT(size) for size in sizes]
    nothing = sparse.csc_matrix((k + terms, k + terms))
    return _clarabel(nothing, c, rows, b, cones)[:k]


def scs_socp(points: np.ndarray) -> np.ndarray:
    import scs

    c, rows, b, sizes = _cones(points)
    k = len(points)
    solver = scs.SCS(
        {"A": rows, "b": b, "c": c}, {"z": 1, "l": k, "q": sizes},
        eps_abs=1e-7, eps_rel=1e-7, verbose=False,
    )  # fmt: skip
    return np.asarray(solver.solve()["x"][:k])


def _clarabel(p, q, rows, b, cones) -> np.ndarray:
    import clarabel

    settings = clarabel.DefaultSettings()
    settings.verbose = False
    return np.asarray(clarabel.DefaultSolver(p, q, rows, b, cones, settings).solve().x)


def _cones(points: np.ndarray) -> tuple[np.ndarray, sparse.csc_matrix, np.ndarray, list[int]]:
    """Variables (w, t), slacks ``b - rows x`` in: zero, nonnegative, (t_l, points_l^T w)."""
    k, terms, size = points.shape
    blocks = [np.hstack([np.ones((1, k)), np.zeros((1, terms))])]
    blocks.append(np.hstack([-np.eye(k), np.zeros((k, terms))]))
    for i in range(terms):
        used = int(np.max(np.flatnonzero(np.any(points[:, i] != 0, axis=0)))) + 1
        block = np.zeros((1 + used, k + terms))
        block[0, k + i] = -1.0
        block[1:, :k] = -points[:, i, :used].T
        blocks.append(block)
    b = np.zeros(sum(len(block) for block in blocks))
    b[0] = 1.0
    c = np.concatenate([np.zeros(k), np.ones(terms)])
    return c, sparse.csc_matrix(np.vstack(blocks)), b, [len(block) for block in blocks[2:]]
