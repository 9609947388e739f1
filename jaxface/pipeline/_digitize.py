"""The whole journey: a photo in, a folder of results out."""

import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxface.io.face_models import load_model
from jaxface.io.formats.image import Photo
from jaxface.io.formats.landmark_file import read_landmarks
from jaxface.models.morphable import MorphableModel
from jaxface.pipeline.fitting._fit import FittedFace, as_photo, fit
from jaxface.pipeline.fitting.outputs import save_fit
from jaxface.pipeline.texture.folder import (
    PAINTED_MODEL,
    CompletionInputs,
    OnStep,
    complete_folder,
    open_inputs,
    silent,
)
from jaxface.pipeline.texture.partial import texture
from jaxface.run.clock import Clock

DEMO = "demo"


def demo_photo() -> Photo:
    """Scikit-image's portrait of Eileen Collins (NASA, public domain)."""
    from skimage import data

    return as_photo(data.astronaut())


def open_photo(photo: str | os.PathLike[str]) -> Photo:
    """A photo by path, or the demo by its name."""
    return demo_photo() if str(photo) == DEMO else as_photo(photo)


def read_mask(path: str | os.PathLike[str]) -> np.ndarray:
    """A mask image as (h, w) values from 0 (not face) to 1 (face)."""
    return as_photo(path).pixels.mean(axis=-1)


def digitize(
    photo: str | os.PathLike[str] | Photo | np.ndarray,
    out: str | os.PathLike[str],
    *,
    resolution: int = 2048,
    with_texture: bool = True,
    complete: bool = False,
    completion: Mapping[str, Any] | None = None,
    on_step: OnStep = silent,
    title: str | None = None,
    landmarks_file: str | os.PathLike[str] | None = None,
    mask_file: str | os.PathLike[str] | None = None,
    **options: Any,
) -> FittedFace:
    """Fit a photo, take its albedo, and write everything into ``out``.

    Args:
        photo: path, ``"demo"``, or array.
        out: folder.
        resolution: of the texture, texels along a side.
        with_texture: take the albedo from the photo.
        complete: complete the albedo, by `complete_folder`; only with ``with_texture``.
        completion: its options.
        on_step: told of the steps of the completion.
        title: name for the report; the file's by default.
        landmarks_file: points to use instead of detection.
        mask_file: image of the photo's size, white on skin.
        options: passed to ``fit``.

    Raises:
        ValueError: as ``fit``, or no completion can be as it is asked for (before the fit).
        FileNotFoundError: a file that does not exist.
    """
    options["model"] = model = _loaded(options)
    inputs = None
    if complete and with_texture:
        inputs = _completion_inputs(model, resolution, completion or {})
    return _digitize(
        photo, out, completion or {}, inputs, resolution=resolution, with_texture=with_texture,
        on_step=on_step, title=title, landmarks_file=landmarks_file, mask_file=mask_file,
        **options,
    )  # fmt: skip


def _digitize(
    photo: str | os.PathLike[str] | Photo | np.ndarray,
    out: str | os.PathLike[str],
    completion: Mapping[str, Any],
    inputs: CompletionInputs | None,
    *,
    resolution: int = 2048,
    with_texture: bool = True,
    on_step: OnStep = silent,
    title: str | None = None,
    landmarks_file: str | os.PathLike[str] | None = None,
    mask_file: str | os.PathLike[str] | None = None,
    **options: Any,
) -> FittedFace:
    if isinstance(photo, str | os.PathLike):
        title = title or (DEMO if str(photo) == DEMO else Path(photo).stem)
        photo = open_photo(photo)
    if landmarks_file is not None:
        options["landmarks"] = read_landmarks(landmarks_file).points
    if mask_file is not None:
        options["mask"] = read_mask(mask_file)
    clock = Clock()
    fitted = fit(photo, clock=clock, **options)
    textured = texture(fitted, resolution, clock=clock) if with_texture else None
    save_fit(fitted, out, textured=textured, title=title or "photo", clock=clock)
    del textured
    if inputs is not None:
        complete_folder(out, on_step=on_step, **_resources(options["model"], completion, inputs))
    return fitted


def _resources(
    model: MorphableModel, completion: Mapping[str, Any], inputs: CompletionInputs
) -> dict[str, Any]:
    return {"model": model, **completion, "database": inputs.database, "features": inputs.network}


def _loaded(options: Mapping[str, Any]) -> MorphableModel:
    model = options.get("model", PAINTED_MODEL)
    return model if isinstance(model, MorphableModel) else load_model(model)


def _completion_inputs(
    model: MorphableModel, resolution: int, completion: Mapping[str, Any]
) -> CompletionInputs | None:
    """What a completion after the fit needs, opened before hours are spent; None if none can be.

    Raises:
        ValueError: as `open_inputs`.
        FileNotFoundError: likewise.
    """
    database = completion.get("database")
    if model.name != PAINTED_MODEL and database is None:
        warnings.warn(
            f"the albedo is left partial: the procedural skins are painted for {PAINTED_MODEL!r}, "
            f"and no database in the UVs of {model.name!r} is named",
            stacklevel=3,
        )
        return None
    side = completion.get("resolution") or resolution
    return open_inputs(model, side, database, completion.get("features", "random"))
