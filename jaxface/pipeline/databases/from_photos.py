"""A database of textures from a folder of photos, as Saito 2017 (section 6) made theirs."""

import dataclasses
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Unpack

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Float
from jaxface.geometry.uv import UVLayout, uv_layout
from jaxface.io.atomic import atomic_path
from jaxface.io.face_models import load_model
from jaxface.io.texture_database import INDEX, TextureDatabase, check_name
from jaxface.models.morphable import MorphableModel
from jaxface.pipeline.databases.photo_fits import BuildStep, FittedPhoto, fit_photos
from jaxface.pipeline.fitting._detail_levels import detail_levels
from jaxface.pipeline.fitting.partial import texture
from jaxface.pipeline.photo import photos_in
from jaxface.stages._common_light import lit_vertices, shared_light
from jaxface.stages.fit import with_self_shadow
from jaxface.stages.fit.options import FitOptions, FitOverrides
from jaxface.stages.scan.transfer import TransferredTexture, whole_texture
from jaxface.stages.texture.mirror import fill_from_mirror, mirror_uv

FITS = "fits"
LIGHT = "common_light.npz"


def build_database(
    photos_dir: str | os.PathLike[str],
    out: str | os.PathLike[str],
    resolution: int = 1024,
    *,
    common_light: bool = True,
    licence: str,
    credits: Sequence[str] = (),
    on_progress: Callable[[BuildStep], None] | None = None,
    name: str | None = None,
    model: str | os.PathLike[str] | MorphableModel = "makehuman",
    remove_specularity: bool = True,
    options: FitOptions | None = None,
    **overrides: Unpack[FitOverrides],
) -> TextureDatabase:
    """Fit every photo of a folder, take its albedo, and write them as a database.

    Each photo is fitted; specularity is removed in SUV space; one light is solved for over all
    of them, up to each photo's exposure; the photos are unwrapped and the light divided out; what
    a photo does not show comes from the other half of the face and from the low frequencies.

    A photo that cannot be read or fitted is told and passed over. Fits stay in ``out/fits`` and
    subjects that the database has are skipped, so a killed run goes on where it stopped. The
    common light is kept as well: photos that are added later are taken to be under it.

    Args:
        photos_dir: with one photo a subject.
        out: folder of the database, new or begun.
        resolution: texels along a side.
        common_light: whether the photos were taken under one light. One that this light
            explains much worse than its own keeps its own, and is told.
        licence: of the photos; they are people's, and only you know what you may do with them.
        credits: lines for the database.
        on_progress: called after each photo of each stage.
        name: of the database; the folder's by default.
        model: bundled name, model file or model, in whose UVs the textures will be.
        remove_specularity: in SUV space, before unwrapping.
        options: of the fits.
        overrides: single ones of these, by their names.

    Raises:
        TypeError: an override that is no option of a fit.
        FileNotFoundError: there is no such folder.
        ValueError: the folder holds no photo, or none with a face; two photos have one name; the
            licence is empty; the resolution is not 16 to 16384; or another database lies in
            ``out``.
    """
    options = dataclasses.replace(options or FitOptions(), **overrides)
    tell = on_progress or (lambda step: None)
    folder = Path(photos_dir)
    if not folder.is_dir():
        raise FileNotFoundError(f"there is no folder of photos {folder}")
    if not licence.strip():
        raise ValueError("licence is empty; say what may be done with the textures of the photos")
    if not 16 <= resolution <= 16384:
        raise ValueError(f"resolution is {resolution}; it needs 16 to 16384 texels")
    photos = photos_in(folder)
    names = [subject_name(photo) for photo in photos]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise ValueError(f"two photos would be one subject: {twice}; rename one of each")
    face = model if isinstance(model, MorphableModel) else load_model(model)
    layout = uv_layout(face.uv, face.uv_faces, resolution)

    def begun() -> TextureDatabase:
        return TextureDatabase.create(
            out, face, resolution, name=name or folder.resolve().name, licence=licence,
            credits=credits,
        )  # fmt: skip

    # What lies there already must fit before hours are spent; what does not is begun with a fit.
    if (Path(out) / INDEX).is_file():
        database = begun()
        if all(database.is_whole(n) for n in names):
            return database
    # Not the occlusion that the model may store: that of these very vertices, at which the photos
    # are compared.
    bare = with_self_shadow(face, False)
    face = with_self_shadow(bare, options.self_shadow)
    fits, first_problem = fit_photos(photos, names, Path(out) / FITS, face, options, tell)
    if not fits:
        raise ValueError(f"no photo of {folder} could be fitted; the first: {first_problem}")
    database = begun()
    if all(database.is_whole(n) for n in fits):
        return database
    paths = dict(zip(names, photos, strict=True))
    sources = {n: FittedPhoto(paths[n], saved, remove_specularity) for n, saved in fits.items()}
    lights = _lights(sources, face, Path(out) / LIGHT, common_light)
    source_uv = jnp.asarray(mirror_uv(face, layout))
    for index, (subject, source) in enumerate(sources.items()):
        problem = lights[subject].problem
        if not database.is_whole(subject):
            albedo, facts = _albedo(source, lights[subject].light, layout, source_uv, face)
            database.write_subject(
                subject, np.asarray(albedo), attributes={**lights[subject].facts, **facts}
            )
        tell(BuildStep("texture", index + 1, len(sources), source.path, problem))
    return database


def subject_name(photo: str | os.PathLike[str]) -> str:
    """The subject's name for a photo's file: its stem, in the letters a name may have."""
    stem = re.sub(r"[^A-Za-z0-9._-]+", "-", Path(photo).stem).lstrip("._-")[:100]
    name = stem or "photo"
    check_name(name)
    return name


class _Lighting(NamedTuple):
    light: Float[Array, "9 3"]
    """of the photo, in units of its working image"""
    facts: dict[str, Any]
    problem: str | None


def _lights(
    sources: dict[str, FittedPhoto], model: MorphableModel, file: Path, common: bool
) -> dict[str, _Lighting]:
    """The light to divide each photo by."""
    if not common:
        return {
            n: _Lighting(s.parameters.light, _facts(s, "own"), None) for n, s in sources.items()
        }
    levels = detail_levels(model, len(next(iter(sources.values())).landmarks), 1, [0])
    samples, gains = [], []
    for source in sources.values():
        fitted = source.fitted(levels)
        data = fitted.working.data
        seen = lit_vertices(source.parameters, model, data.image, data.mask, data.principal)
        # All in the units of the photos' own linear light, in which exposures compare.
        gains.append(fitted.working.gain)
        samples.append(eqx.tree_at(lambda v: v.colour, seen, seen.colour / fitted.working.gain))
    known = _read_light(file)
    shared = shared_light(samples, model.albedo_mean, model.albedo.basis, light=known)
    if shared.light is None:
        told = (
            f"the photos share no light: {shared.alike.sum()} of {len(samples)} would be under it"
        )
        return {
            n: _Lighting(s.parameters.light, _facts(s, "own"), f"{s.path.name}: {told}")
            for n, s in sources.items()
        }
    if known is None:
        with atomic_path(file) as temporary, open(temporary, "wb") as handle:
            np.savez(handle, light=np.asarray(shared.light))
    result = {}
    for i, (subject, source) in enumerate(sources.items()):
        misfit, least = float(shared.misfit[i]), float(shared.own_misfit[i])
        facts = {"misfit": round(misfit, 4), "own_light_misfit": round(least, 4)}
        if shared.alike[i]:
            exposure = float(shared.gains[i])
            facts = {**_facts(source, "common"), "light_gain": round(exposure, 4), **facts}
            result[subject] = _Lighting(shared.light * exposure * gains[i], facts, None)
        else:
            problem = (
                f"{source.path.name} is not under the common light (misfit {misfit:.3f}, under "
                f"its own {least:.3f}); its own is divided out"
            )
            facts = {**_facts(source, "own"), **facts}
            result[subject] = _Lighting(source.parameters.light, facts, problem)
    return result


def _read_light(file: Path) -> Float[Array, "9 3"] | None:
    if not file.is_file():
        return None
    try:
        with np.load(file, allow_pickle=False) as stored:
            light = np.asarray(stored["light"], np.float32)
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise ValueError(f"{file} cannot be read ({error}); delete it to solve anew") from error
    if light.shape != (9, 3) or not np.isfinite(light).all():
        raise ValueError(f"{file} holds no light of (9, 3) numbers; delete it to solve anew")
    return jnp.asarray(light)


def _facts(source: FittedPhoto, light: str) -> dict[str, Any]:
    return {
        "photo": source.metadata["photo"],
        "landmark_error": round(float(source.metadata["landmark_error"]), 5),
        "light": light,
    }


def _albedo(
    source: FittedPhoto,
    light: Float[Array, "9 3"],
    layout: UVLayout,
    source_uv: Float[Array, "r r 2"],
    model: MorphableModel,
) -> tuple[Float[Array, "r r 3"], dict[str, Any]]:
    """A whole albedo texture, linear RGB, and how much of it the photo shows."""
    levels = detail_levels(model, len(source.landmarks), 3)
    textured = texture(source.fitted(levels, light), layout.resolution)
    partial = textured.partial
    whole, borrowed = fill_from_mirror(
        partial.albedo, partial.weight, textured.low_frequency, source_uv
    )
    inside = layout.triangle >= 0
    covered = jnp.maximum(jnp.sum(inside), 1)
    facts = {
        "seen": round(float(jnp.sum(partial.weight * inside) / covered), 4),
        "mirrored": round(float(jnp.sum(borrowed * inside) / covered), 4),
    }
    found = TransferredTexture(jnp.clip(whole, 0.0, 1.0), inside.astype(whole.dtype))
    return whole_texture(found, model, layout), facts
