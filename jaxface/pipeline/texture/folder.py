"""`jaxface texture`: complete the albedo in a folder that a fit has written, and resume it."""

import dataclasses
import json
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from jaxface._types import Float
from jaxface.io.atomic import atomic_path
from jaxface.io.digest import digest
from jaxface.io.feature_weights import load_network, network_digest
from jaxface.io.formats.image import write_png
from jaxface.io.texture_database import TextureDatabase, databases_dir
from jaxface.models.morphable import MorphableModel
from jaxface.networks.texture_features.network import FeatureNetwork
from jaxface.pipeline.databases.painted import PAINTING, synth_database
from jaxface.pipeline.texture._complete import (
    Completed,
    CompletionSettings,
    Level,
    check_subjects,
    complete,
)
from jaxface.pipeline.texture.outputs import save_completed
from jaxface.pipeline.texture.seen import SMALLEST, SeenTexture, model_of, read_seen_texture
from jaxface.run.kept_programs import source_digest
from jaxface.run.memory import hand_back_freed_memory
from jaxface.stages.texture._synthesise import SynthesisWeights

PAINTED_MODEL = "makehuman"
"""in whose UVs the procedural skins are"""

SUBJECTS = 24
"""of the procedural database that is made where none is named"""

LARGEST_DATABASE = 2048
"""texels of its textures at most; finer maps are synthesised from these"""

PREVIEW_SECONDS = 30.0
WORK_FOLDER = ".completion"

OnStep = Callable[[str, int, int], None]


def silent(what: str, done: int, of: int) -> None:
    """Tell nobody of a step."""


def complete_folder(
    folder: str | os.PathLike[str],
    *,
    database: str | os.PathLike[str] | None = None,
    features: str = "random",
    resolution: int | None = None,
    settings: CompletionSettings | None = None,
    model: str | os.PathLike[str] | MorphableModel | None = None,
    on_step: OnStep = silent,
) -> Completed:
    """Complete the albedo of a digitized photo, and write map, meshes, pictures and report.

    A run that was killed goes on at the level where it stopped, if it is repeated with the same
    settings.

    Args:
        folder: written by `save_fit` with textures.
        database: folder of a texture database; by default a procedural one, made once and kept
            in the cache.
        features: name or file of the feature network, see `load_network`.
        resolution: texels along a side; as the partial albedo has by default.
        settings: see `CompletionSettings`.
        model: the model or its file, where the fit is not of a bundled one.
        on_step: told of every step.

    Raises:
        FileNotFoundError: the folder lacks the fit, or database or weights are nowhere.
        ValueError: files are damaged or do not fit together.
    """
    place, settings = Path(folder), settings or CompletionSettings()
    started = time.perf_counter()
    hand_back_freed_memory()  # the fit's
    network = load_network(features)
    face = model_of(place, model)
    seen = read_seen_texture(place, resolution, face)
    # Complete, if smooth: a first look while the database is painted and compared.
    write_png(place / "albedo_preview.png", seen.low_frequency)
    textures = open_database(database, face, seen.resolution, on_step)
    work = _Checkpoint(place, settings, network, textures, seen)
    shown = -PREVIEW_SECONDS  # the first picture is shown at once

    def on_progress(
        what: str, done: int, of: int, picture: Callable[[], Float[np.ndarray, "h w 3"]] | None
    ) -> None:
        nonlocal shown
        on_step(what, done, of)
        if picture is not None and (done == of or time.perf_counter() - shown > PREVIEW_SECONDS):
            shown = time.perf_counter()
            write_png(place / "albedo_preview.png", picture())

    done = complete(
        seen, textures, network, settings,
        on_progress=on_progress, resumed=work.read, finished=work.write,
    )  # fmt: skip
    seconds = time.perf_counter() - started
    save_completed(place, done, seen, textures, network.licence, seconds)
    work.clear()
    (place / "albedo_preview.png").unlink(missing_ok=True)
    return done


def check_inputs(
    model: MorphableModel,
    resolution: int,
    database: str | os.PathLike[str] | None = None,
    features: str = "random",
) -> None:
    """Raise at once what `complete_folder` would raise once a photo is fitted.

    Args:
        model: that is to be fitted.
        resolution: as for `complete_folder`.
        database: likewise.
        features: likewise.

    Raises:
        FileNotFoundError: database or weights are nowhere.
        ValueError: they are damaged, the database is in other UVs or too small, or so is the
            resolution.
    """
    if resolution < SMALLEST:
        raise ValueError(f"resolution is {resolution}; a completion needs {SMALLEST} or more")
    load_network(features)
    if database is not None:
        check_subjects(TextureDatabase(database, model))


def open_database(
    path: str | os.PathLike[str] | None,
    model: MorphableModel,
    resolution: int,
    on_step: OnStep = silent,
) -> TextureDatabase:
    """The database of a path; without one the procedural one, made where it is not there yet.

    Raises:
        FileNotFoundError: there is no database.
        ValueError: it is in the UVs of another model, or there is none for this model.
    """
    if path is not None:
        return TextureDatabase(path, model)
    if model.name != PAINTED_MODEL:
        raise ValueError(
            f"the procedural skins are painted for {PAINTED_MODEL!r}, not for {model.name!r}; name "
            "a database in this model's UVs"
        )
    size = min(resolution, LARGEST_DATABASE)
    folder = databases_dir() / f"procedural-v{PAINTING}-{size}"
    return synth_database(
        folder, SUBJECTS, size, on_progress=lambda i, n: on_step("procedural skins", i, n)
    )


class _Checkpoint:
    """Finished levels of one completion, kept until it is whole."""

    def __init__(
        self,
        place: Path,
        settings: CompletionSettings,
        network: FeatureNetwork,
        textures: TextureDatabase,
        seen: SeenTexture,
    ) -> None:
        stamps = [f"{name} {textures.stamp(name)}" for name in textures.names]
        self.key = digest(
            source_digest(),
            repr(settings),
            network_digest(network),
            *stamps,
            seen.photo,
            seen.weight,
        )[:16]
        self.folder = place / WORK_FOLDER

    def _file(self, level: int) -> Path:
        return self.folder / f"{self.key}-{level}.npz"

    def read(self, level: int) -> Level | None:
        """A finished level, or None where there is none, or its file is damaged."""
        try:
            with np.load(self._file(level), allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}
            record = json.loads(str(arrays.pop("record")))
            return Level(arrays.pop("image"), arrays, record)
        except (OSError, ValueError, KeyError, EOFError):
            return None

    def write(self, level: int, done: Level) -> None:
        """Keep a level."""
        with atomic_path(self._file(level)) as temporary, open(temporary, "wb") as file:
            entries: dict[str, Any] = {**done.targets, "image": done.image}
            np.savez(file, record=np.array(json.dumps(done.record)), **entries)

    def clear(self) -> None:
        """Everything is written: forget the levels."""
        shutil.rmtree(self.folder, ignore_errors=True)


def parse_settings(
    *,
    detail: str | None = None,
    photo: float | None = None,
    **given: Any,
) -> CompletionSettings:
    """`CompletionSettings` from a command line.

    Args:
        detail: ``region=value,...``.
        photo: weight of what the photo shows.
        given: fields of `CompletionSettings`.

    Raises:
        ValueError: a value is out of range, or ``detail`` cannot be read.
    """
    regions = {}
    for part in (detail or "").split(",") if detail else []:
        name, _, value = part.partition("=")
        try:
            regions[name.strip()] = float(value)
        except ValueError:
            raise ValueError(f"--detail has {part!r}; region=value is needed") from None
    settings = dataclasses.replace(CompletionSettings(), detail=regions, **given)
    if photo is not None:
        settings = dataclasses.replace(settings, weights=SynthesisWeights(photo=photo))
    if settings.norm not in ("frobenius", "squared"):
        raise ValueError(f"norm is {settings.norm!r}; it must be 'frobenius' or 'squared'")
    if settings.start not in ("neighbour", "low_frequency"):
        raise ValueError(f"start is {settings.start!r}; it must be 'neighbour' or 'low_frequency'")
    if settings.iterations < 1 or not settings.alpha >= 0 or not (photo or 0) >= 0:
        raise ValueError(
            f"iterations {settings.iterations}, alpha {settings.alpha}, weight of the photo "
            f"{photo}; needed are at least one iteration and weights of 0 or more"
        )
    return settings
