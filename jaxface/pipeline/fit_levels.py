"""The levels of a fit as programs, compiled side by side and kept between processes."""

import functools
from typing import Any

import jax

from jaxface.models.parameters import FaceParameters, neutral_parameters
from jaxface.pipeline.clock import Clock, KeptProgram, quick_compilation
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
    join_records,
)


@functools.cache
def _start_program() -> KeptProgram:
    return KeptProgram("fit_start", fit_start, quick_compilation())


@functools.cache
def _level_program(level: int) -> KeptProgram:
    function = functools.partial(fit_level, level=level)
    return KeptProgram(f"fit_level_{level}", function, quick_compilation())


@functools.cache
def _shadow_program(level: int) -> KeptProgram:
    function = functools.partial(fit_shadows, level=level)
    return KeptProgram(f"fit_shadows_{level}", function, quick_compilation())


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
        (_start_program(), (data, models[0], weights, config))
    ]
    for level, model in enumerate(models):
        if follows_shadows(models, config, level):
            calls.append((_shadow_program(level), (y, data, model, models[0], config)))
        calls.append((_level_program(level), (y, data, model, weights, config)))
    clock.prepare("fit", calls)
    y, record = clock.run("fit", _start_program(), data, models[0], weights, config)
    records, shadowed, occlusion = [record], [], None
    for level, model in enumerate(models):
        if follows_shadows(models, config, level):
            program = _shadow_program(level)
            y, occlusion = clock.run("fit", program, y, data, model, models[0], config)
        if occlusion is not None:
            model = model.with_occlusion(occlusion)
        y, record = clock.run("fit", _level_program(level), y, data, model, weights, config)
        records.append(record)
        shadowed.append(model)
    return y, join_records(records, shadowed[-1].model.occlusion), tuple(shadowed)
