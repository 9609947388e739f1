"""A model at the levels of detail of a fit, and the last one's kept."""

import functools
from collections.abc import Sequence

import jax

from jaxface.models.morphable import MorphableModel
from jaxface.models.subdivide import subdivide
from jaxface.stages.fit import FitModel, prepare
from jaxface.stages.fit.self_shadow import with_self_shadow

SUBDIVIDED_BELOW = 20_000
"""models with fewer vertices are refined once for the finer pyramid levels"""


def detail_levels(
    model: MorphableModel, landmark_count: int, levels: int, details: Sequence[int] | None = None
) -> tuple[FitModel, ...]:
    """The model prepared for each pyramid level, coarsest first.

    Args:
        model: any morphable model.
        landmark_count: 68 or 468.
        levels: pyramid levels.
        details: how often the model is subdivided at each level; by default never at the
            coarsest, and once at the others if it has fewer than ``SUBDIVIDED_BELOW`` vertices.

    Raises:
        ValueError: ``details`` does not have one entry a level, or it decreases.
    """
    if details is None:
        finer = int(model.vertex_count < SUBDIVIDED_BELOW)
        details = [0] + [finer] * (levels - 1)
    if len(details) != levels or list(details) != sorted(details) or min(details) < 0:
        raise ValueError(
            f"details is {list(details)}; {levels} subdivision counts, not decreasing, are needed"
        )
    prepared: dict[int, FitModel] = {}
    current, done = model, 0
    for detail in details:
        if detail > done:
            current, done = subdivide(current, detail - done), detail
        if detail not in prepared:
            prepared[detail] = prepare(current, landmark_count)
    return tuple(prepared[detail] for detail in details)


class _Same:
    """A model as a key: equal to itself alone."""

    def __init__(self, model: MorphableModel):
        self.model = model

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and other.model is self.model

    def __hash__(self) -> int:
        return id(self.model)


@functools.lru_cache(maxsize=1)
def _kept_levels(
    same: _Same, self_shadow: bool, count: int, levels: int, details: tuple[int, ...] | None
) -> tuple[FitModel, ...]:
    return detail_levels(with_self_shadow(same.model, self_shadow), count, levels, details)


def prepared_levels(
    model: MorphableModel,
    self_shadow: bool,
    landmark_count: int,
    levels: int,
    details: Sequence[int] | None = None,
) -> tuple[FitModel, ...]:
    """``detail_levels``, those of the last call kept: a third of a fit at 72k vertices.

    A model with leaves that may change in place (NumPy's) is prepared each time.

    Args:
        model: any morphable model.
        self_shadow: whether it is to have ``occlusion``: its own, or else that of its mean face.
        landmark_count: as for ``detail_levels``.
        levels: likewise.
        details: likewise.

    Raises:
        ValueError: as ``detail_levels``.
    """
    fixed = all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(model))
    prepare_levels = _kept_levels if fixed else _kept_levels.__wrapped__
    wanted = None if details is None else tuple(details)
    return prepare_levels(_Same(model), self_shadow, landmark_count, levels, wanted)
