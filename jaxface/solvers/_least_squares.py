"""Nonlinear least squares on any residual, by optimistix."""

from collections.abc import Callable
from typing import Literal

import optimistix as optx

from jaxface._types import PyTree
from jaxface.solvers.solution import Solution

_SOLVERS = {
    "levenberg_marquardt": optx.LevenbergMarquardt,
    "gauss_newton": optx.GaussNewton,
    "dogleg": optx.Dogleg,
}


def least_squares(
    fn: Callable[[PyTree, PyTree], PyTree],
    y0: PyTree,
    args: PyTree = None,
    *,
    method: Literal["levenberg_marquardt", "gauss_newton", "dogleg"] = "levenberg_marquardt",
    steps: int = 100,
    rtol: float = 1e-5,
    atol: float = 1e-6,
) -> Solution:
    """Minimise ``||fn(y, args)||^2``.

    Differentiable with respect to ``args`` by the implicit function theorem.

    Args:
        fn: the residual, a pytree of arrays; ``Energy.residual`` of composed terms fits.
        y0: start.
        args: problem data.
        method: Levenberg-Marquardt, plain Gauss-Newton, or Powell's dogleg.
        steps: greatest number of steps.
        rtol: relative tolerance on the step and on the energy.
        atol: absolute tolerance on the same.

    Returns:
        ``stats``: ``num_steps`` and ``max_steps``. In float32 ``rtol`` below 1e-5 is not reached.

    Raises:
        ValueError: an unknown method.
    """
    if method not in _SOLVERS:
        raise ValueError(f"method is {method!r}; it must be one of {sorted(_SOLVERS)}")
    solver = _SOLVERS[method](rtol=rtol, atol=atol)
    found = optx.least_squares(fn, solver, y0, args, max_steps=steps, throw=False)
    return Solution(found.value, found.result, found.stats)
