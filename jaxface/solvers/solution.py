"""What every solver returns."""

from typing import Any, NamedTuple

import optimistix as optx

from jaxface._types import Array, Bool, PyTree
from jaxface.solvers.finiteness import not_finite_words


class Solution(NamedTuple):
    """Result of a solve.

    Attributes:
        value: the minimiser, shaped as the start.
        result: why the solver stopped, one of ``optimistix.RESULTS``: ``successful`` says that
            energy and gradient are finite and that the stopping rule was met;
            ``nonlinear_max_steps_reached`` that all steps were used; ``stagnation`` that no step
            lowered the energy though its gradient says that one should; ``nonfinite`` that a
            number was NaN or infinite. `reason` puts it in words.
        stats: numbers of the run; each solver's docstring lists them. All have ``not_finite``:
            by name of each term three flags, whether its value, its gradient (of a residual: its
            Jacobian) and its curvature held an entry that was not finite.
    """

    value: PyTree
    result: Any
    stats: dict[str, Any]

    @property
    def converged(self) -> Any:
        """Boolean array: the solver's own test of convergence held."""
        return self.result == optx.RESULTS.successful


def stopped(
    broken: Bool[Array, ""] | bool,
    converged: Bool[Array, ""] | bool,
    stuck: Bool[Array, ""] | bool,
) -> Any:
    """The result of a solve: not finite, converged, stuck, or else out of steps, in this order."""
    results: Any = optx.RESULTS
    result = results.where(stuck, results.stagnation, results.nonlinear_max_steps_reached)
    result = results.where(converged, results.successful, result)
    return results.where(broken, results.nonfinite, result)


def reason(solution: Solution | Any) -> str:
    """Why a (concrete, unbatched) solve stopped, in words.

    Args:
        solution: what the solver returned, or its ``result`` alone; only the former can name the
            term that was not finite.
    """
    if not isinstance(solution, Solution):
        solution = Solution(None, solution, {})
    result = solution.result
    if result == optx.RESULTS.successful:
        return "converged"
    if result == optx.RESULTS.nonlinear_max_steps_reached:
        if solution.stats.get("watcher"):
            return "ended by on_step"
        gap = solution.stats.get("relative_gap")
        certified = (
            "" if gap is None else f"; the certified gap is {float(gap):.1e} of the objective"
        )
        return f"used all its steps{certified}"
    if result == optx.RESULTS.stagnation:
        return "stuck: no step lowered the energy, though its gradient is not small"
    if result == optx.RESULTS.nonfinite:
        words = not_finite_words(solution.stats.get("not_finite", {}))
        return f"not finite (NaN or infinite): {words or 'the unknowns'}"
    return str(optx.RESULTS[result])
