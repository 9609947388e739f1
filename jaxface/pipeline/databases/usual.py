"""The database that a completion uses: the one that is named, or else the procedural one."""

import os
from collections.abc import Callable

from jaxface.io.texture_database import TextureDatabase, databases_dir
from jaxface.models.morphable import MorphableModel
from jaxface.pipeline.databases.painted import PAINTING, synth_database

PAINTED_MODEL = "makehuman"
"""in whose UVs the procedural skins are"""

SUBJECTS = 24
"""of the procedural database that is made where none is named"""

LARGEST_DATABASE = 2048
"""texels of its textures at most; finer maps are synthesised from these"""

OnStep = Callable[[str, int, int], None]


def silent(what: str, done: int, of: int) -> None:
    """Tell nobody of a step."""


def open_database(
    path: str | os.PathLike[str] | TextureDatabase | None,
    model: MorphableModel,
    resolution: int,
    on_step: OnStep = silent,
) -> TextureDatabase:
    """The database of a path; without one the procedural one, made where it is not there yet.

    Raises:
        FileNotFoundError: there is no database.
        ValueError: it is in the UVs of another model, or there is none for this model.
    """
    if isinstance(path, TextureDatabase):
        return path
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
