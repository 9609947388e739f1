"""The whole fit: its stages in their order."""

import functools
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from jaxface.models.parameters import FaceParameters
from jaxface.stages.fit.prepared import FitModel
from jaxface.stages.fit.records import FitConfig, FitInput, FitStats, FitWeights, join_records
from jaxface.stages.fit.solve import fit_level, fit_shadows, level_side
from jaxface.stages.fit.start import fit_start


def fit_parameters(
    data: FitInput,
    models: tuple[FitModel, ...],
    weights: FitWeights,
    config: FitConfig,
    start: FaceParameters | None = None,
) -> tuple[FaceParameters, FitStats]:
    """The whole fit as one pure function: jit it, vmap it over ``data``.

    In the precision of the models: with those in double precision the fit is, wherever
    `jax_enable_x64` is set.

    Args:
        data: working image and landmarks.
        models: the model at each level of detail, coarsest first, one for each pyramid level.
        weights: term weights.
        config: steps and sizes.
        start: where to begin; by default with the landmarks alone (``fit_start``).

    Returns:
        The parameters and the history.
    """
    y, stats, _ = through_levels(data, models, weights, config, start=start)
    return y, stats


def through_levels(
    data: FitInput,
    models: tuple[FitModel, ...],
    weights: FitWeights,
    config: FitConfig,
    call: Callable[..., Any] = lambda stage, *args: stage(*args),
    start: FaceParameters | None = None,
) -> tuple[FaceParameters, FitStats, tuple[FitModel, ...]]:
    """The stages of ``fit_parameters`` in their order, each made by ``call``.

    Args:
        data: working image and landmarks.
        models: the model at each level of detail, coarsest first.
        weights: term weights.
        config: steps and sizes.
        call: ``call(stage, *args)`` with the answer of ``stage(*args)``, where stage is one of
            ``level_stages``.
        start: where to begin; by default with the landmarks alone (``fit_start``).

    Returns:
        Parameters, history, and the models with the shadows that they were fitted with.
    """
    y, records, shadowed, cast = start, [], [], None
    if y is None:
        y, record = call(fit_start, data, models[0], weights, config)
        records.append(record)
    stages = level_stages(data, models, config)
    for level, (model, (shadows, fitting)) in enumerate(zip(models, stages, strict=True)):
        if shadows is not None:
            y, *cast = call(shadows, y, data, model, models[0], config)
        if cast is not None:
            model = model.with_occlusion(*cast)
        y, record = call(fitting, y, data, model, weights, config, jnp.asarray(level))
        records.append(record)
        shadowed.append(model)
    finest = shadowed[-1].model
    stats = join_records(records, finest.occlusion, finest.occlusion_slope)
    return y, stats, tuple(shadowed)


def level_stages(
    data: FitInput, models: tuple[FitModel, ...], config: FitConfig
) -> list[tuple[functools.partial[Any] | None, functools.partial[Any]]]:
    """Of each level ``fit_shadows``, if it is due, and ``fit_level``, with their static settings.

    Two levels of one mesh share a canvas and so a program, in pairs from the finest: the coarser
    one's image fills a quarter of it. To share it with a third would cost that more than it saves.
    """
    counts = [model.model.vertex_count for model in models]
    stages = []
    for level, count in enumerate(counts):
        coarser_of_pair = (len(counts) - level) % 2 == 0
        shared = coarser_of_pair and counts[level + 1] == count
        canvas = level_side(data, config, level + 1 if shared else level)
        shadows = functools.partial(fit_shadows, level=level)
        due = _follows_shadows(models, config, level)
        stages.append((shadows if due else None, functools.partial(fit_level, canvas=canvas)))
    return stages


def _follows_shadows(models: tuple[FitModel, ...], config: FitConfig, level: int) -> bool:
    """Whether hard shadows are looked for before a level.

    Not before the first, where the shape is still that of the landmarks alone; before the second,
    and again where a level has a finer mesh than the one before.
    """
    if level == 0 or config.shadow_directions == 0 or models[level].model.occlusion is None:
        return False
    counts = [m.model.vertex_count for m in models]
    return level == 1 or counts[level] != counts[level - 1]
