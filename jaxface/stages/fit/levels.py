"""The whole fit: its stages in their order."""

from collections.abc import Callable
from typing import Any

from jaxface.models.parameters import FaceParameters
from jaxface.stages.fit.prepared import FitModel
from jaxface.stages.fit.records import FitConfig, FitInput, FitStats, FitWeights, join_records
from jaxface.stages.fit.solve import fit_level, fit_shadows, fit_start


def fit_parameters(
    data: FitInput,
    models: tuple[FitModel, ...],
    weights: FitWeights,
    config: FitConfig,
) -> tuple[FaceParameters, FitStats]:
    """The whole fit as one pure function: jit it, vmap it over ``data``.

    Args:
        data: working image and landmarks.
        models: the model at each level of detail, coarsest first, one for each pyramid level.
        weights: term weights.
        config: steps and sizes.

    Returns:
        The parameters and the history.
    """
    y, stats, _ = through_levels(
        data, models, weights, config, lambda stage, level, *args: stage(*args, level)
    )
    return y, stats


def through_levels(
    data: FitInput,
    models: tuple[FitModel, ...],
    weights: FitWeights,
    config: FitConfig,
    call: Callable[..., Any],
) -> tuple[FaceParameters, FitStats, tuple[FitModel, ...]]:
    """The stages of ``fit_parameters`` in their order, each made by ``call``.

    Args:
        data: working image and landmarks.
        models: the model at each level of detail, coarsest first.
        weights: term weights.
        config: steps and sizes.
        call: ``call(stage, level, *args)`` with the answer of ``stage(*args, level)``, where stage
            is ``fit_start``, ``fit_shadows`` or ``fit_level``.

    Returns:
        Parameters, history, and the models with the shadows that they were fitted with.
    """
    y, record = call(fit_start, 0, data, models[0], weights, config)
    records, shadowed, occlusion = [record], [], None
    for level, model in enumerate(models):
        if follows_shadows(models, config, level):
            y, occlusion = call(fit_shadows, level, y, data, model, models[0], config)
        if occlusion is not None:
            model = model.with_occlusion(occlusion)
        y, record = call(fit_level, level, y, data, model, weights, config)
        records.append(record)
        shadowed.append(model)
    return y, join_records(records, shadowed[-1].model.occlusion), tuple(shadowed)


def follows_shadows(models: tuple[FitModel, ...], config: FitConfig, level: int) -> bool:
    """Whether hard shadows are looked for before a level.

    Not before the first, where the shape is still that of the landmarks alone; before the second,
    and again where a level has a finer mesh than the one before.
    """
    if level == 0 or config.shadow_directions == 0 or models[level].model.occlusion is None:
        return False
    counts = [m.model.vertex_count for m in models]
    return level == 1 or counts[level] != counts[level - 1]
