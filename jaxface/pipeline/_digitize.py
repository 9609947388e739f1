"""The whole journey: a photo in, a folder of results out."""

import dataclasses
import os
import warnings
from pathlib import Path
from typing import NamedTuple, Unpack

import numpy as np

from jaxface.io.face_models import load_model
from jaxface.io.formats.image import Photo
from jaxface.io.formats.landmark_file import read_landmarks
from jaxface.models.morphable import MorphableModel
from jaxface.pipeline.databases.usual import PAINTED_MODEL, OnStep, silent
from jaxface.pipeline.fitting._fit import FittedFace, fit
from jaxface.pipeline.fitting.outputs import save_fit
from jaxface.pipeline.fitting.partial import texture
from jaxface.pipeline.options import DigitizeOptions, DigitizeOverrides
from jaxface.pipeline.photo import DEMO, open_photo, read_mask
from jaxface.pipeline.texture.folder import (
    CompletionInputs,
    complete_folder,
    open_inputs,
)
from jaxface.run.clock import Clock


def digitize(
    photo: str | os.PathLike[str] | Photo | np.ndarray,
    out: str | os.PathLike[str],
    options: DigitizeOptions | None = None,
    *,
    on_step: OnStep = silent,
    title: str | None = None,
    **overrides: Unpack[DigitizeOverrides],
) -> FittedFace:
    """Fit a photo, take its albedo and complete it, and write everything into ``out``.

    Args:
        photo: path, ``"demo"``, or array.
        out: folder.
        options: the settings; `DigitizeOptions` says what there is, `DigitizeOptions()` being the
            default.
        on_step: told of the steps of the completion.
        title: name for the report; the file's by default.
        overrides: single settings, by their names in ``options``, as ``resolution=1024``.

    Raises:
        TypeError: an override that is no setting.
        ValueError: as ``fit``, or no completion can be as it is asked for (before the fit).
        FileNotFoundError: a file that does not exist.
    """
    opened = open_digitize(dataclasses.replace(options or DigitizeOptions(), **overrides))
    return digitize_opened(photo, out, opened, on_step=on_step, title=title)


class Opened(NamedTuple):
    """Settings of a journey, and what they name, opened once.

    Attributes:
        options: the settings.
        model: the morphable model.
        completion: what a completion needs; None where there is none.
    """

    options: DigitizeOptions
    model: MorphableModel
    completion: CompletionInputs | None


def open_digitize(options: DigitizeOptions) -> Opened:
    """Open the model, and what a completion needs, before hours are spent.

    Raises:
        ValueError: a file is damaged, or no completion can be as it is asked for.
        FileNotFoundError: a file does not exist.
    """
    model = options.model
    model = model if isinstance(model, MorphableModel) else load_model(model)
    if not (options.complete and options.with_texture):
        return Opened(options, model, None)
    if model.name != PAINTED_MODEL and options.database is None:
        warnings.warn(
            f"the albedo is left partial: the procedural skins are painted for {PAINTED_MODEL!r}, "
            f"and no database in the UVs of {model.name!r} is named; `jaxface database transfer "
            "--model MODEL -o DIR` carries them over, for --database DIR",
            stacklevel=3,
        )
        return Opened(options, model, None)
    inputs = open_inputs(model, options.resolution, options.database, options.features)
    return Opened(options, model, inputs)


def digitize_opened(
    photo: str | os.PathLike[str] | Photo | np.ndarray,
    out: str | os.PathLike[str],
    opened: Opened,
    *,
    on_step: OnStep = silent,
    title: str | None = None,
) -> FittedFace:
    """As `digitize`, for many photos with the same settings."""
    if isinstance(photo, str | os.PathLike):
        title = title or (DEMO if str(photo) == DEMO else Path(photo).stem)
        photo = open_photo(photo)
    options, clock = opened.options, Clock()
    fitted = fit(
        photo, opened.model, options.fit, clock=clock,
        landmarks=None if options.landmarks is None else read_landmarks(options.landmarks).points,
        mask=None if options.mask is None else read_mask(options.mask),
    )  # fmt: skip
    textured = texture(fitted, options.resolution, clock=clock) if options.with_texture else None
    save_fit(fitted, out, textured=textured, title=title or "photo", clock=clock)
    del textured
    complete_opened(out, opened, on_step=on_step)
    return fitted


def complete_opened(
    out: str | os.PathLike[str], opened: Opened, *, on_step: OnStep = silent
) -> None:
    """Complete the albedo of a folder that is fitted already, if a completion is asked for."""
    if opened.completion is not None:
        complete_folder(
            out, database=opened.completion.database, features=opened.completion.network,
            options=opened.options.completion, model=opened.model, on_step=on_step,
        )  # fmt: skip
