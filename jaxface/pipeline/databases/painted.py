"""A database of procedural skins on disk."""

import os
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

from jaxface.geometry.uv import uv_layout
from jaxface.io.face_models import load_model
from jaxface.io.file_lock import exclusive
from jaxface.io.texture_database import TextureDatabase
from jaxface.models.morphable import MorphableModel
from jaxface.models.skin.attributes import random_attributes
from jaxface.models.skin.regions import skin_fields
from jaxface.models.skin.synthesis import synthesise_skin

PAINTING = 2
"""counts up when the same seed paints another skin, so that no cache mixes the two"""

LOCK = ".painting.lock"
"""held by the one process that paints; not the index's, which others may need meanwhile"""

LICENCE = "CC0-1.0"
CREDITS = ("procedural skin of jaxface over albedo statistics of MakeHuman skins (CC0)",)


def synth_database(
    out: str | os.PathLike[str],
    subjects: int,
    resolution: int = 1024,
    seed: int = 0,
    on_progress: Callable[[int, int], None] | None = None,
    model: str = "makehuman",
) -> TextureDatabase:
    """Write ``subjects`` procedural skins into a folder; go on where an earlier call stopped.

    Subject i depends on the seed and i alone, so a database can be enlarged later. Of several
    processes that want one database, one paints and the others wait for it; should it end before
    it is done, another goes on. One that is there whole is opened without waiting or writing.

    Args:
        out: the folder.
        subjects: how many the database shall hold.
        resolution: texels along a side.
        seed: of the population.
        on_progress: called with (subjects present, subjects) after each, and while it waits.
        model: whose UVs to paint in.

    Raises:
        ValueError: ``subjects`` is under 1, or another database lies in the folder.
        OSError: the folder cannot be written, and the database is not there whole.
    """
    if subjects < 1:
        raise ValueError(f"subjects is {subjects}; at least 1 is needed")
    face, folder = load_model(model), Path(out)
    tell = on_progress or (lambda done, of: None)

    def begun() -> TextureDatabase:
        return TextureDatabase.create(
            folder, face, resolution, name=f"procedural-{seed}", licence=LICENCE, credits=CREDITS
        )

    names = [f"skin-{seed}-{index:04d}" for index in range(subjects)]
    database = begun()
    if all(database.is_whole(name) for name in names):
        tell(subjects, subjects)
        return database

    def waiting() -> None:
        present = begun()
        tell(sum(name in present for name in names), subjects)

    with exclusive(folder / LOCK, waiting, poll=0.5):
        database = begun()
        _paint(database, face, seed, names, tell)
    return database


def _paint(
    database: TextureDatabase,
    face: MorphableModel,
    seed: int,
    names: list[str],
    tell: Callable[[int, int], None],
) -> None:
    layout = uv_layout(face.uv, face.uv_faces, database.resolution)
    fields = skin_fields(face)
    for index, name in enumerate(names):
        if not database.is_whole(name):
            traits, details = jax.random.split(jax.random.fold_in(jax.random.key(seed), index))
            attributes = random_attributes(traits)
            albedo = synthesise_skin(face, layout, attributes, details, fields)
            database.write_subject(
                name, np.asarray(albedo), attributes={**attributes.summary(), "seed": [seed, index]}
            )
        tell(index + 1, len(names))
