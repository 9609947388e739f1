"""The levels of a fit as programs, compiled side by side and kept between processes."""

import functools
from collections.abc import Callable
from typing import Any

import jax

from jaxface._compilation import quick_compilation
from jaxface.models.parameters import FaceParameters, neutral_parameters
from jaxface.pipeline.clock import Clock, KeptProgram
from jaxface.pipeline.programs import keep_structure
from jaxface.stages.fit import (
    FitConfig,
    FitInput,
    FitModel,
    FitStats,
    FitWeights,
    LevelRecord,
    fit_level,
    fit_shadows,
    fit_start,
    follows_shadows,
    through_levels,
)


@functools.cache
def _program(stage: Callable[..., Any], level: int) -> KeptProgram:
    function = functools.partial(stage, level=level)
    return KeptProgram(f"{stage.__name__}_{level}", function, quick_compilation())


def fit_levels(
    clock: Clock,
    data: FitInput,
    models: tuple[FitModel, ...],
    weights: FitWeights,
    config: FitConfig,
) -> tuple[FaceParameters, FitStats, tuple[FitModel, ...]]:
    """``fit_parameters``, a program a level, so that they compile side by side.

    Returns:
        Parameters, history, and the models with the shadows that they were fitted with.
    """
    y = jax.eval_shape(neutral_parameters, models[0].model)
    keep_structure(y)
    keep_structure(LevelRecord({}, y.log_focal, y.identity))
    calls: list[tuple[KeptProgram, tuple[Any, ...]]] = [
        (_program(fit_start, 0), (data, models[0], weights, config))
    ]
    for level, model in enumerate(models):
        if follows_shadows(models, config, level):
            calls.append((_program(fit_shadows, level), (y, data, model, models[0], config)))
        calls.append((_program(fit_level, level), (y, data, model, weights, config)))
    clock.prepare("fit", calls)

    def call(stage: Callable[..., Any], level: int, *args: Any) -> Any:
        return clock.run("fit", _program(stage, level), *args)

    return through_levels(data, models, weights, config, call)
