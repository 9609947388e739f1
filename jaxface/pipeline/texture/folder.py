"""`jaxface texture`: complete the albedo in a folder that a fit has written, and resume it."""

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxface._types import Float
from jaxface.io.checkpoint import Checkpoint
from jaxface.io.digest import digest
from jaxface.io.feature_weights import load_network, network_digest
from jaxface.io.formats.image import write_png
from jaxface.io.texture_database import TextureDatabase
from jaxface.models.morphable import MorphableModel
from jaxface.networks.texture_features.network import FeatureNetwork
from jaxface.pipeline.databases.usual import OnStep, open_database, silent
from jaxface.pipeline.texture._complete import check_subjects, complete
from jaxface.pipeline.texture.options import CompletionOptions
from jaxface.pipeline.texture.outputs import save_completed
from jaxface.pipeline.texture.records import Completed, Level
from jaxface.pipeline.texture.seen import (
    SMALLEST,
    SeenTexture,
    fitted_model,
    read_folder_fit,
    read_seen_texture,
)
from jaxface.run.kept_programs import source_digest
from jaxface.run.memory import hand_back_freed_memory

PREVIEW_SECONDS = 30.0
WORK_FOLDER = ".completion"


class CompletionInputs(NamedTuple):
    """What a completion needs beside a fit, opened once.

    Attributes:
        network: extractor of features.
        database: textures; None: the procedural ones, painted when they are needed.
    """

    network: FeatureNetwork
    database: TextureDatabase | None


def open_inputs(
    model: MorphableModel,
    resolution: int,
    database: str | os.PathLike[str] | TextureDatabase | None = None,
    features: str | FeatureNetwork = "random",
) -> CompletionInputs:
    """Open and check what `complete_folder` will need, before a photo is fitted.

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
    network = features if isinstance(features, FeatureNetwork) else load_network(features)
    if database is None:
        return CompletionInputs(network, None)
    if not isinstance(database, TextureDatabase):
        database = TextureDatabase(database, model)
    check_subjects(database)
    return CompletionInputs(network, database)


def complete_folder(
    folder: str | os.PathLike[str],
    *,
    database: str | os.PathLike[str] | TextureDatabase | None = None,
    features: str | FeatureNetwork = "random",
    resolution: int | None = None,
    options: CompletionOptions | None = None,
    model: str | os.PathLike[str] | MorphableModel | None = None,
    on_step: OnStep = silent,
) -> Completed:
    """Complete the albedo of a digitized photo, and write map, meshes, pictures and report.

    A run that was killed goes on at the level where it stopped, if it is repeated with the same
    options.

    Args:
        folder: written by `save_fit` with textures.
        database: texture database or its folder; by default a procedural one, made once and kept
            in the cache.
        features: the feature network, its name or file, see `load_network`.
        resolution: texels along a side; as the partial albedo has by default.
        options: see `CompletionOptions`.
        model: the model or its file, where the fit is not of a bundled one.
        on_step: told of every step.

    Raises:
        FileNotFoundError: the folder lacks the fit, or database or weights are nowhere.
        ValueError: files are damaged or do not fit together.
    """
    place, options = Path(folder), options or CompletionOptions()
    started = time.perf_counter()
    hand_back_freed_memory()  # the fit's
    network = features if isinstance(features, FeatureNetwork) else load_network(features)
    saved = read_folder_fit(place)
    face = fitted_model(place, saved, model)
    seen = read_seen_texture(
        place, resolution, face,
        saved=saved, plausible=options.plausible, whole=options.extent == "whole",
    )  # fmt: skip
    # Complete, if smooth: a first look while the database is painted and compared.
    write_png(place / "albedo_preview.png", seen["low_frequency"])
    textures = open_database(database, face, seen.resolution, on_step)
    work = _Levels(place, options, network, textures, seen)
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
        seen, textures, network, options,
        on_progress=on_progress, resumed=work.read, finished=work.write,
    )  # fmt: skip
    seconds = time.perf_counter() - started
    save_completed(place, done, seen, saved.parameters, textures, network.licence, seconds)
    work.clear()
    (place / "albedo_preview.png").unlink(missing_ok=True)
    return done


class _Levels:
    """Finished levels of one completion, kept until it is whole."""

    def __init__(
        self,
        place: Path,
        options: CompletionOptions,
        network: FeatureNetwork,
        textures: TextureDatabase,
        seen: SeenTexture,
    ) -> None:
        stamps = [f"{name} {textures.stamp(name)}" for name in textures.names]
        key = digest(
            source_digest(),
            repr(options),
            network_digest(network),
            *stamps,
            seen["photo"],
            seen.weight,
        )
        self._kept = Checkpoint(place / WORK_FOLDER, key[:16])

    def read(self, level: int) -> Level | None:
        """A finished level, or None where there is none, or its file is damaged."""
        found = self._kept.read(str(level))
        if found is None:
            return None
        arrays, record = found
        image = arrays.pop("image", None)
        return None if image is None else Level(image, arrays, record)

    def write(self, level: int, done: Level) -> None:
        """Keep a level."""
        self._kept.write(str(level), {**done.targets, "image": done.image}, done.record)

    def clear(self) -> None:
        """Everything is written: forget the levels."""
        self._kept.clear()
