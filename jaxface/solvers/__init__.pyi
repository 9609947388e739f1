from ._gauss_newton import (
    GaussNewton,
    Problem,
    gauss_newton,
    posterior_covariance,
)
from ._least_squares import least_squares
from ._minimise import minimise
from .lbfgs import LBFGSState, lbfgs_start, lbfgs_step
from .nonnegative import nonnegative_least_squares
from .simplex import minimise_on_simplex
from .solution import Solution, reason

__all__ = [
    "GaussNewton",
    "LBFGSState",
    "Problem",
    "Solution",
    "gauss_newton",
    "lbfgs_start",
    "lbfgs_step",
    "least_squares",
    "minimise",
    "minimise_on_simplex",
    "nonnegative_least_squares",
    "posterior_covariance",
    "reason",
]
