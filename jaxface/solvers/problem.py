"""What a second-order solver is given: an energy, its quadratic model, what a step holds fixed."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxface._types import Array, PyTree


class Problem(NamedTuple):
    """An energy with a second-order model.

    Attributes:
        energy: ``(y, data) -> (value, parts)`` with ``parts`` a dict of scalars to report.
        quadratic: ``(y, data) -> ((value, gradient, curvature), parts)`` in the flattened ``y``,
            with ``energy(y + d) ~ value + gradient . d + d^T curvature d``. A fourth entry of the
            model may be a dict with, for each part, three flags: whether its value, its gradient
            and its curvature hold numbers that are not finite.
        refresh: ``(y, args) -> data``: what is held fixed during one step.
    """

    energy: Callable[[PyTree, PyTree], tuple[Array, dict[str, Array]]]
    quadratic: Callable[[PyTree, PyTree], tuple[Any, dict[str, Array]]]
    refresh: Callable[[PyTree, PyTree], PyTree] = lambda y, args: args

    @classmethod
    def of(
        cls, energy: Any, refresh: Callable[[PyTree, PyTree], PyTree] = lambda y, args: args
    ) -> "Problem":
        """That of an energy with methods ``value`` and ``quadratic``, as ``compose`` makes it."""
        return cls(energy.value, energy.quadratic, refresh)
