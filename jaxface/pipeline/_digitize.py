"""Whole journeys: a photo or a folder of photos in, a folder of results out."""

import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxface.io.face_models import load_model
from jaxface.io.formats.image import Photo
from jaxface.io.formats.landmark_file import read_landmarks
from jaxface.models.morphable import MorphableModel
from jaxface.pipeline.fitting._fit import FittedFace, as_photo, fit
from jaxface.pipeline.fitting.outputs import save_fit
from jaxface.pipeline.texture.folder import (
    PAINTED_MODEL,
    OnStep,
    check_inputs,
    complete_folder,
    silent,
)
from jaxface.pipeline.texture.partial import texture
from jaxface.run.clock import Clock

DEMO = "demo"
PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp", ".exr")


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
    completing = complete and with_texture and _can_complete(model, resolution, completion or {})
    return _digitize(
        photo, out, completion or {}, completing, resolution=resolution, with_texture=with_texture,
        on_step=on_step, title=title, landmarks_file=landmarks_file, mask_file=mask_file,
        **options,
    )  # fmt: skip


def _digitize(
    photo: str | os.PathLike[str] | Photo | np.ndarray,
    out: str | os.PathLike[str],
    completion: Mapping[str, Any],
    completing: bool,
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
    if completing:
        complete_folder(out, on_step=on_step, **{"model": options["model"], **completion})
    return fitted


def _loaded(options: Mapping[str, Any]) -> MorphableModel:
    model = options.get("model", PAINTED_MODEL)
    return model if isinstance(model, MorphableModel) else load_model(model)


def _can_complete(model: MorphableModel, resolution: int, completion: Mapping[str, Any]) -> bool:
    """Whether a completion can follow the fit, told before hours are spent.

    Raises:
        ValueError: as `check_inputs`.
        FileNotFoundError: likewise.
    """
    database = completion.get("database")
    if model.name != PAINTED_MODEL and database is None:
        warnings.warn(
            f"the albedo is left partial: the procedural skins are painted for {PAINTED_MODEL!r}, "
            f"and no database in the UVs of {model.name!r} is named",
            stacklevel=3,
        )
        return False
    side = completion.get("resolution") or resolution
    check_inputs(model, side, database, completion.get("features", "random"))
    return True


class FolderEntry(NamedTuple):
    """What became of one photo of a folder.

    Attributes:
        photo: its path.
        out: the folder of its results.
        fitted: the fit, if it was made now.
        error: why there is none.
    """

    photo: Path
    out: Path
    fitted: FittedFace | None
    error: str | None


def photos_in(folder: str | os.PathLike[str]) -> list[Path]:
    """The photos of a folder by name.

    Raises:
        ValueError: it holds none.
    """
    found = sorted(p for p in Path(folder).iterdir() if p.suffix.lower() in PHOTO_SUFFIXES)
    if not found:
        raise ValueError(f"folder {folder} holds no photo ({', '.join(PHOTO_SUFFIXES)})")
    return found


def digitize_folder(
    photos: Sequence[Path],
    out: str | os.PathLike[str],
    *,
    on_start: Callable[[Path], None] = lambda photo: None,
    **options: Any,
) -> Iterator[FolderEntry]:
    """Digitize photos one after the other into folders of ``out`` named after them.

    Photos whose folder has a report already are passed over, so a killed run goes on where it
    stopped; one that cannot be fitted is told and does not end the run. All share one
    compiled program.

    Args:
        photos: files with different stems.
        out: folder.
        on_start: called before each photo.
        options: passed to ``digitize``.

    Raises:
        ValueError: two photos would share a folder, or no completion can be as it is asked for.
        FileNotFoundError: there is no such model, database or file of weights.
    """
    folders = [Path(out) / photo.stem for photo in photos]
    if len(set(folders)) < len(folders):
        raise ValueError("photos whose names differ only in the suffix would share a folder")
    completion, complete = options.pop("completion", None) or {}, options.pop("complete", False)
    with_texture, resolution = options.get("with_texture", True), options.get("resolution", 2048)
    options["model"] = model = _loaded(options)
    completing = complete and with_texture and _can_complete(model, resolution, completion)
    for photo, folder in zip(photos, folders, strict=True):
        on_start(photo)
        fitted = None
        try:
            if not (folder / "report.json").is_file():
                fitted = _digitize(photo, folder, completion, completing, **options)
            elif completing and not (folder / "albedo.png").is_file():
                complete_folder(folder, **{"model": model, **completion})
            yield FolderEntry(photo, folder, fitted, None)
        except (ValueError, FileNotFoundError) as error:
            yield FolderEntry(photo, folder, None, str(error))
