from ._gauss_newton import GaussNewton, gauss_newton
from ._least_squares import least_squares
from ._minimise import minimise
from ._posterior_covariance import posterior_covariance
from .finiteness import NotFiniteError, not_finite_words, require_finite
from .lbfgs import LBFGSState, lbfgs_start, lbfgs_step
from .nonnegative import nonnegative_least_squares
from .problem import Problem
from .simplex import minimise_on_simplex
from .solution import Solution, reason

__all__ = [
    "GaussNewton",
    "LBFGSState",
    "NotFiniteError",
    "Problem",
    "Solution",
    "gauss_newton",
    "lbfgs_start",
    "lbfgs_step",
    "least_squares",
    "minimise",
    "minimise_on_simplex",
    "nonnegative_least_squares",
    "not_finite_words",
    "posterior_covariance",
    "reason",
    "require_finite",
]
