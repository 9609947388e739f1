"""Textures that exist already into a database: skins in MakeHuman's layout, and head scans."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxface.geometry.uv import uv_layout
from jaxface.imaging.colour import srgb_to_linear
from jaxface.io.face_models import load_model
from jaxface.io.skin_atlas import atlas_uv, read_skin, skin_name
from jaxface.io.texture_database import TextureDatabase
from jaxface.stages.scan.transfer import resample_texture, whole_texture


def import_skins(
    skins: Sequence[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    resolution: int = 1024,
    *,
    name: str = "makehuman-skins",
    licence: str = "CC0-1.0",
    credits: Sequence[str] = ("MakeHuman skins (makehumancommunity.org)",),
    on_progress: Callable[[int, int], None] | None = None,
) -> TextureDatabase:
    """Bring MakeHuman skins (body maps or head crops) into the bundled model's UVs.

    Skins that the database already holds are skipped.

    Args:
        skins: image files.
        out: folder of the database, new or begun.
        resolution: texels along a side.
        name: of a new database.
        licence: of the skins.
        credits: lines for the database.
        on_progress: called with (skins done, skins) after each.

    Raises:
        FileNotFoundError: a file is absent.
        ValueError: a file is no skin, two have one name, or another database lies in the folder.
    """
    model = load_model("makehuman")
    database = TextureDatabase.create(
        out, model, resolution, name=name, licence=licence, credits=credits
    )
    names = [skin_name(path) for path in skins]
    if len(set(names)) != len(names):
        raise ValueError(f"two skins have one name: {sorted(names)}")
    layout = uv_layout(model.uv, model.uv_faces, resolution)
    source_uv = layout(jnp.asarray(atlas_uv(model)), model.uv_faces, fill=jnp.nan)
    for index, (path, subject) in enumerate(zip(skins, names, strict=True)):
        if not database.is_whole(subject):
            pixels, known = read_skin(path)
            linear = srgb_to_linear(jnp.asarray(pixels))
            found = resample_texture(linear, jnp.asarray(known), source_uv, layout)
            albedo = whole_texture(found, model, layout)
            database.write_subject(
                subject, np.asarray(albedo), attributes={"file": Path(path).name}
            )
        if on_progress is not None:
            on_progress(index + 1, len(names))
    return database
