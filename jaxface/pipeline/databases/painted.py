"""A database of procedural skins on disk."""

import os
from collections.abc import Callable

import jax
import numpy as np

from jaxface.geometry.uv import uv_layout
from jaxface.io.face_models import load_model
from jaxface.io.texture_database import TextureDatabase
from jaxface.models.skin.attributes import random_attributes
from jaxface.models.skin.regions import skin_fields
from jaxface.models.skin.synthesis import synthesise_skin

PAINTING = 2
"""counts up when the same seed paints another skin, so that no cache mixes the two"""

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

    Subject i depends on the seed and i alone, so a database can be enlarged later.

    Args:
        out: the folder.
        subjects: how many the database shall hold.
        resolution: texels along a side.
        seed: of the population.
        on_progress: called with (subjects present, subjects) after each.
        model: whose UVs to paint in.

    Raises:
        ValueError: ``subjects`` is under 1, or another database lies in the folder.
    """
    if subjects < 1:
        raise ValueError(f"subjects is {subjects}; at least 1 is needed")
    face = load_model(model)
    database = TextureDatabase.create(
        out, face, resolution, name=f"procedural-{seed}", licence=LICENCE, credits=CREDITS
    )
    layout, fields = uv_layout(face.uv, face.uv_faces, resolution), skin_fields(face)
    for index in range(subjects):
        name = f"skin-{seed}-{index:04d}"
        if not database.is_whole(name):
            traits, details = jax.random.split(jax.random.fold_in(jax.random.key(seed), index))
            attributes = random_attributes(traits)
            albedo = synthesise_skin(face, layout, attributes, details, fields)
            database.write_subject(
                name, np.asarray(albedo), attributes={**attributes.summary(), "seed": [seed, index]}
            )
        if on_progress is not None:
            on_progress(index + 1, subjects)
    return database
