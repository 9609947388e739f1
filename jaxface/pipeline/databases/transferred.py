"""A database of textures in one model's UVs, carried over into another's."""

import os
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Float
from jaxface.geometry.uv import UVLayout, uv_layout
from jaxface.io.face_models import load_model
from jaxface.io.texture_database import TextureDatabase, uv_digest
from jaxface.models.morphable import MorphableModel
from jaxface.pipeline.databases.usual import open_database
from jaxface.stages.scan.head_scan import mean_head
from jaxface.stages.scan.register import register_topology
from jaxface.stages.scan.transfer import complete_texture, own_parts, resample_texture, surface_uv

RESOLUTION = 1024
"""texels along a side where neither a resolution nor a database is named"""


def transfer_database(
    model: str | os.PathLike[str] | MorphableModel,
    out: str | os.PathLike[str],
    database: str | os.PathLike[str] | None = None,
    resolution: int | None = None,
    *,
    source: str | os.PathLike[str] | MorphableModel = "makehuman",
    on_progress: Callable[[str, int, int], None] | None = None,
) -> TextureDatabase:
    """Carry the textures of a database into the UVs of another model; go on where a run stopped.

    The model's topology is laid over the mean face of the database's model, by 68 landmarks, its
    identity and non-rigid ICP; every texel then takes what lies nearest to it on that surface.
    Eyes and mouth are the model's own. Licences, credits and attributes go with the textures.

    Args:
        model: into whose UVs: bundled name, model file or model.
        out: folder of the new database, or of one that was begun.
        database: folder or name of one in the UVs of ``source``; by default the procedural skins.
        resolution: texels along a side; by default the database's.
        source: the model in whose UVs the textures are.
        on_progress: called with (what, done, of).

    Raises:
        FileNotFoundError: there is no such model or database.
        ValueError: a model has no 68 landmarks; the database is in the UVs of another model than
            ``source``, or in those of ``model`` already; or another database lies in ``out``.
    """
    tell = on_progress or (lambda what, done, of: None)
    target, origin = (
        m if isinstance(m, MorphableModel) else load_model(m) for m in (model, source)
    )
    if target.landmarks68 is None or origin.landmarks68 is None:
        raise ValueError(
            f"model {target.name!r} has no 68 landmarks, by which it is laid over "
            f"{origin.name!r}; run `jaxface model embed-landmarks` to find them"
        )
    if uv_digest(target) == uv_digest(origin):
        raise ValueError(
            f"model {target.name!r} has the UVs of {origin.name!r}: nothing to transfer"
        )
    textures = open_database(database, origin, resolution or RESOLUTION, tell)
    side = resolution or textures.resolution
    made = TextureDatabase.create(
        out, target, side, name=f"{textures.name}-{target.name}", licence=textures.licence,
        credits=textures.credits,
    )  # fmt: skip
    records = {s.name: {**s.attributes, "transferred": textures.name} for s in textures.subjects}
    there = {s.name for s in made.subjects if s.attributes == records.get(s.name)}
    if all(name in there and made.is_whole(name) for name in records):
        return made
    layout = uv_layout(target.uv, target.uv_faces, side)
    marks = np.asarray(origin.landmarks68(origin.mean), np.float64)
    registered = register_topology(
        mean_head(origin), marks, target,
        on_progress=lambda done, of: tell("registration", done, of),
    )  # fmt: skip
    source_uv = jnp.asarray(surface_uv(registered, target, layout))
    elsewhere, skin = own_parts(target, layout)
    for index, subject in enumerate(textures.subjects):
        if subject.name not in there or not made.is_whole(subject.name):
            albedo = jnp.asarray(textures.albedo(subject.name))
            carried = _carried(albedo, source_uv, layout, elsewhere, skin)
            made.write_subject(
                subject.name, np.asarray(carried), licence=subject.licence,
                attributes=records[subject.name],
            )  # fmt: skip
        tell("textures", index + 1, len(records))
    return made


@jax.jit
def _carried(
    albedo: Float[Array, "h w 3"],
    source_uv: Float[Array, "r r 2"],
    layout: UVLayout,
    elsewhere: Float[Array, "r r 3"],
    skin: Float[Array, "r r"],
) -> Float[Array, "r r 3"]:
    known = jnp.ones(albedo.shape[:2], bool)
    found = resample_texture(albedo, known, source_uv, layout)
    return complete_texture(found, elsewhere, layout, skin)
