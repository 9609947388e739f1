"""Finding a model by name or file, and describing what was found."""

import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from jaxface.io.face_models.assemble import ModelFormatError
from jaxface.io.face_models.bfm import load_bfm2009, load_bfm_h5
from jaxface.io.face_models.flame import load_flame
from jaxface.io.face_models.ict import load_ict
from jaxface.io.face_models.model_file import bundled_models, load_bundled
from jaxface.io.face_models.model_file import load_model as load_own
from jaxface.io.face_models.surrey import load_surrey
from jaxface.models.linear import LinearBasis
from jaxface.models.morphable import MorphableModel

_BY_SUFFIX: dict[str, Callable[..., MorphableModel]] = {
    ".mat": load_bfm2009,
    ".h5": load_bfm_h5,
    ".hdf5": load_bfm_h5,
    ".pkl": load_flame,
    ".bin": load_surrey,
}


def load_model(
    name_or_path: str | os.PathLike[str] = "makehuman", **options: Any
) -> MorphableModel:
    """A bundled model by name, or any supported file or folder by path.

    ``.mat`` is the Basel Face Model 2009, ``.h5`` that of 2017 or 2019, ``.pkl`` FLAME, ``.bin``
    a model as eos stores it (Surrey), a folder ICT-FaceKit, and an ``.npz`` is told apart by its
    contents: this package's own format, FLAME, or ICT-FaceKit.

    Args:
        name_or_path: one of `bundled_models`, or a path.
        options: passed to the loader, e.g. ``landmarks=``; none for bundled and own files.

    Raises:
        ValueError: neither a bundled name nor a supported file; or the file is malformed.
        FileNotFoundError: a path with a supported suffix that does not exist.
    """
    path = Path(name_or_path)
    if isinstance(name_or_path, str) and name_or_path in bundled_models():
        return _without_options(load_bundled, options)(name_or_path)
    if path.is_dir():
        return load_ict(path, **options)
    suffix = path.suffix.lower()
    if suffix in _BY_SUFFIX or suffix == ".npz":
        if not path.is_file():
            raise FileNotFoundError(f"no model file {str(path)!r}")
        loader = _BY_SUFFIX.get(suffix) or _npz_loader(path, options)
        return loader(path, **options)
    raise ValueError(
        f"no model {str(name_or_path)!r}: needed one of the bundled {bundled_models()}, a file "
        f"ending in {', '.join([*_BY_SUFFIX, '.npz'])}, or an ICT-FaceKit folder"
    )


def _npz_loader(path: Path, options: dict[str, Any]) -> Callable[..., MorphableModel]:
    try:
        with zipfile.ZipFile(path) as archive:
            names = {Path(name).stem for name in archive.namelist()}
    except zipfile.BadZipFile as error:
        raise ModelFormatError(path, f"no npz archive ({error})", "a whole .npz file") from error
    if "shapedirs" in names:
        return load_flame
    if "id_modes" in names:
        return load_ict
    if "metadata" in names:
        return _without_options(load_own, options)
    raise ModelFormatError(
        path, f"arrays {sorted(names)}", "a jaxface model, FLAME ('shapedirs') or ICT ('id_modes')"
    )


def _without_options(
    loader: Callable[..., MorphableModel], options: dict[str, Any]
) -> Callable[..., MorphableModel]:
    if options:
        raise ValueError(f"options {sorted(options)} do not apply to a jaxface model file")
    return loader


def describe(model: MorphableModel) -> dict[str, Any]:
    """Plain facts of a model, JSON-able: sizes, extent, landmarks, regions, licence."""
    mean = np.asarray(model.mean, np.float64)
    extent = mean.max(axis=0) - mean.min(axis=0)
    uv = np.asarray(model.uv)
    return {
        "name": model.name,
        "licence": model.licence,
        "vertices": int(model.vertex_count),
        "triangles": int(model.faces.shape[0]),
        "quads": None if model.quads is None else int(np.sum(np.asarray(model.quads)[:, 3] >= 0)),
        "extent_mm": [round(float(size), 1) for size in extent],
        "identity_modes": model.identity.count,
        "identity_rms_mm": _rms(model.identity),
        "expression_modes": model.expression.count,
        "expression_names": list(model.expression_names),
        "albedo_modes": model.albedo.count,
        "albedo_mean_linear_rgb": [
            round(float(value), 4) for value in np.asarray(model.albedo_mean).mean(axis=0)
        ],
        "landmarks68": model.landmarks68 is not None,
        "landmarks468": model.landmarks468 is not None,
        "uv_corners": len(uv),
        "uv_range": [
            [round(float(v), 4) for v in uv.min(axis=0)],
            [round(float(v), 4) for v in uv.max(axis=0)],
        ],
        "regions": {
            name: int(np.sum(np.asarray(model.region) == index))
            for index, name in enumerate(model.region_names)
        },
    }


def _rms(basis: LinearBasis) -> float:
    """Root mean square displacement (mm) of a vertex of a random face of the model."""
    if basis.count == 0:
        return 0.0
    values = np.asarray(basis.basis, np.float64)
    return round(float(np.sqrt(np.sum(values**2) / len(values))), 3)
