"""The levels of a fit as programs, compiled side by side and kept between processes."""

import contextlib
import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp

from jaxface._compilation import quick_compilation, quickest_compilation
from jaxface.models.parameters import FaceParameters, neutral_parameters
from jaxface.run.clock import Clock, KeptProgram
from jaxface.run.kept_programs import keep_structure
from jaxface.stages.fit import (
    FitConfig,
    FitInput,
    FitModel,
    FitStats,
    FitWeights,
    LevelRecord,
    fit_shadows,
    fit_start,
    through_levels,
)


@functools.cache
def _kept(stage: Callable[..., Any], settings: tuple[tuple[str, int], ...]) -> KeptProgram:
    name = "_".join([stage.__name__, *(f"{key}{value}" for key, value in settings)])
    # The start takes a few steps over the landmarks, and one pass over the vertices: 0.1 s so.
    options = quickest_compilation() if stage is fit_start else quick_compilation()
    return KeptProgram(name, functools.partial(stage, **dict(settings)), options)


def _program(stage: Callable[..., Any]) -> KeptProgram:
    if isinstance(stage, functools.partial):
        return _kept(stage.func, tuple(sorted(stage.keywords.items())))
    return _kept(stage, ())


@contextlib.contextmanager
def compiling_levels(
    clock: Clock,
    data: FitInput,
    models: tuple[FitModel, ...],
    weights: FitWeights,
    config: FitConfig,
    start: FaceParameters | None = None,
) -> Iterator[None]:
    """Compile what ``fit_levels`` will run beside what is done inside the ``with``.

    If that raises, programs not begun are dropped; those that are finish in the background.

    Args:
        clock: compiles, and runs the programs later.
        data: the input, or ``input_shapes``.
        models: as for ``fit_parameters``.
        weights: likewise.
        config: likewise.
        start: likewise, or its shapes.
    """
    y = jax.eval_shape(neutral_parameters, models[0].model)
    record = LevelRecord({}, y.log_focal, y.identity)
    keep_structure(y)
    keep_structure(record)
    calls: list[tuple[KeptProgram, tuple[Any, ...]]] = []

    def call(stage: Callable[..., Any], *args: Any) -> Any:
        # No more than shapes of the answer, and of records none that another stage would ask for.
        calls.append((_program(stage), args))
        if getattr(stage, "func", stage) is fit_shadows:
            return y, *_cast_shapes(args[2])
        return y, record

    through_levels(data, models, weights, config, call, start)
    drop = clock.begin(calls)
    try:
        yield
    except BaseException:
        drop()
        raise


def _cast_shapes(model: FitModel) -> tuple[Any, Any]:
    """Shapes of what ``fit_shadows`` gives for a model beside the parameters."""
    mean = model.model.mean

    def nothing() -> tuple[Any, Any]:
        return jnp.zeros((len(mean), 9), mean.dtype), jnp.zeros((len(mean), 3, 9), mean.dtype)

    return jax.eval_shape(nothing)


def fit_levels(
    clock: Clock,
    data: FitInput,
    models: tuple[FitModel, ...],
    weights: FitWeights,
    config: FitConfig,
    start: FaceParameters | None = None,
) -> tuple[FaceParameters, FitStats, tuple[FitModel, ...]]:
    """``fit_parameters``, a program a stage: those of ``compiling_levels``, which comes first.

    Returns:
        Parameters, history, and the models with the shadows that they were fitted with.
    """

    def call(stage: Callable[..., Any], *args: Any) -> Any:
        return clock.run("fit", _program(stage), *args)

    return through_levels(data, models, weights, config, call, start)
