"""What every solver returns."""

from typing import Any, NamedTuple

import optimistix as optx

from jaxface._types import PyTree


class Solution(NamedTuple):
    """Result of a solve.

    Attributes:
        value: the minimiser, shaped as the start.
        result: why the solver stopped (``optimistix.RESULTS``); ``reason`` puts it in words.
        stats: numbers of the run; each solver's docstring lists them.
    """

    value: PyTree
    result: Any
    stats: dict[str, Any]

    @property
    def converged(self) -> Any:
        """Boolean array: the solver's own test of convergence held."""
        return self.result == optx.RESULTS.successful


def reason(result: Any) -> str:
    """Why a (concrete, unbatched) solve stopped, in words."""
    if result == optx.RESULTS.successful:
        return "converged"
    if result == optx.RESULTS.nonlinear_max_steps_reached:
        return "used all its steps"
    return str(optx.RESULTS[result])
