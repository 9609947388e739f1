"""The Basel Face Model: 2009 (``.mat``) and 2017 / 2019 (``.h5``).

Paysan et al., "A 3D Face Model for Pose and Illumination Invariant Face Recognition", AVSS 2009;
Gerig et al., "Morphable Face Models - An Open Framework", FG 2018. Both have +y up and +z
forward; 2009 is in micrometres with sRGB 0-255, 2017 and 2019 in millimetres with sRGB 0-1.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxface._types import Float
from jaxface.io.face_models.assemble import (
    ModelFormatError,
    Modes,
    SourceModel,
    assemble,
    require,
    scaled_modes,
    vertex_major,
)
from jaxface.io.face_models.colour import linear_albedo
from jaxface.io.face_models.landmarks import read_landmarks68
from jaxface.models.morphable import MorphableModel

_LICENCE = "Basel Face Model {year}, University of Basel: licensed to its holder for research"
_KEYS_2009 = ("shapeMU", "shapePC", "shapeEV", "texMU", "texPC", "texEV", "tl")


def load_bfm2009(
    path: str | Path, *, landmarks: str | Path | Sequence[str | Path] | None = None
) -> MorphableModel:
    """Load ``01_MorphableModel.mat``: 53,490 vertices, 199 identity and 199 albedo modes.

    ``shapeEV`` and ``texEV`` are standard deviations although their name says eigenvalues. The
    texture, sRGB 0-255, becomes linear light (see `linear_albedo`). The four segments of
    ``segbin``, where present, become regions unless landmarks give finer ones. The file has no
    expressions, UVs or landmarks.

    Args:
        path: a MATLAB file of version 5 to 7.3.
        landmarks: the 68 points in any form `read_landmarks68` knows.

    Raises:
        ValueError: not such a file, or its parts disagree.
    """
    content = _read_mat(Path(path))
    missing = [key for key in _KEYS_2009 if key not in content]
    require(not missing, path, f"variables {sorted(content)}", f"also {missing}")
    shape, std = vertex_major(path, "shapePC", content["shapePC"]), _vector(content["shapeEV"])
    mean = _vertex_vector(path, "shapeMU", content["shapeMU"])
    texture = vertex_major(path, "texPC", content["texPC"])
    texture_mean = _vertex_vector(path, "texMU", content["texMU"])
    triangles = np.asarray(content["tl"])
    require(triangles.ndim == 2 and triangles.shape[1] == 3, path, f"tl {triangles.shape}", "(f,3)")
    require(
        std.shape == shape.shape[2:] and _vector(content["texEV"]).shape == texture.shape[2:],
        path,
        f"{std.size} and {_vector(content['texEV']).size} standard deviations for "
        f"{shape.shape[2]} shape and {texture.shape[2]} texture modes",
        "one a mode",
    )
    albedo_mean, albedo = linear_albedo(
        texture_mean / 255.0, texture, _vector(content["texEV"]) / 255.0
    )
    faces = triangles.astype(np.int64).astype(np.int32) - 1  # MATLAB counts from one
    points = read_landmarks68(landmarks, faces, len(mean))
    region, names = None, ("head",)
    if "segbin" in content and points is None:
        segments = np.asarray(content["segbin"])
        require(
            segments.ndim == 2 and len(segments) == len(mean),
            path,
            f"segbin of shape {segments.shape}",
            f"({len(mean)}, 4)",
        )
        region = np.argmax(segments, axis=1).astype(np.int32)
        names = tuple(f"segment{i + 1}" for i in range(segments.shape[1]))
    return assemble(
        SourceModel(
            path=Path(path),
            name="bfm2009",
            licence=_LICENCE.format(year=2009),
            mean=mean * 1e-3,
            faces=faces,
            identity=scaled_modes(shape, std * 1e-3),
            albedo_mean=albedo_mean,
            albedo=albedo,
            region=region,
            region_names=names,
            landmarks68=points,
        )
    )


def load_bfm_h5(
    path: str | Path, *, landmarks: str | Path | Sequence[str | Path] | None = None
) -> MorphableModel:
    """Load a statismo HDF5 of 2017 or 2019 (``model2017-1_bfm_nomouth.h5``, ``model2019_*``).

    The mean is the sum of the shape's and the expression's. The file names landmarks by anatomy,
    not by the 68 numbers; where it does use numbers ("1" to "68") they are taken over, each as
    the vertex of the mean shape nearest to its coordinates.

    Args:
        path: the HDF5 file.
        landmarks: the 68 points in any form `read_landmarks68` knows.

    Raises:
        ValueError: not such a file, or its parts disagree.
        ImportError: h5py is not installed.
    """
    import h5py

    path = Path(path)
    if not h5py.is_hdf5(path):
        raise ModelFormatError(path, "no HDF5 signature", "an HDF5 file of the Basel Face Model")
    with h5py.File(path, "r") as file:
        parts: dict[str, tuple[np.ndarray, Modes] | None] = {
            name: _statismo(file, path, name) for name in ("shape", "expression", "color")
        }
        if parts["shape"] is None:
            raise ModelFormatError(path, f"groups {sorted(file)}", "shape/model and others")
        cells = _dataset(file, path, "shape/representer/cells")
        defined = _numbered_landmarks(file, parts["shape"][0])
    require(
        cells.ndim == 2 and 3 in cells.shape,
        path,
        f"shape/representer/cells of shape {cells.shape}",
        "(3, f)",
    )
    faces = np.ascontiguousarray((cells.T if cells.shape[0] == 3 else cells).astype(np.int32))
    mean, identity = parts["shape"]
    expression = None
    if parts["expression"] is not None:
        offset, expression = parts["expression"]
        require(
            offset.shape == mean.shape,
            path,
            f"an expression model of {len(offset)} vertices",
            f"{len(mean)}, those of the shape",
        )
        mean = mean + offset
    albedo_mean = albedo = None
    if parts["color"] is not None:
        encoded, modes = parts["color"]
        scale = 255.0 if encoded.max() > 2.0 else 1.0
        albedo_mean, albedo = linear_albedo(
            encoded / scale, modes.basis / scale, np.ones(len(modes.std))
        )
        albedo.std = modes.std / scale
    return assemble(
        SourceModel(
            path=path,
            name=path.stem,
            licence=_LICENCE.format(year="2019" if "2019" in path.stem else "2017"),
            mean=mean,
            faces=faces,
            identity=identity,
            expression=expression,
            albedo_mean=albedo_mean,
            albedo=albedo,
            landmarks68=read_landmarks68(landmarks, faces, len(mean), definitions=defined),
        )
    )


def _statismo(file: Any, path: Path, group: str) -> tuple[np.ndarray, Modes] | None:
    """Mean (n, 3) and modes of one statismo model, or None where the file lacks it."""
    if f"{group}/model" not in file:
        return None
    mean = _vertex_vector(path, f"{group}/model/mean", _dataset(file, path, f"{group}/model/mean"))
    matrix = _dataset(file, path, f"{group}/model/pcaBasis")
    basis = vertex_major(path, f"{group}/model/pcaBasis", matrix)
    variance = _vector(_dataset(file, path, f"{group}/model/pcaVariance"))
    require(
        len(basis) == len(mean)
        and variance.shape == basis.shape[2:]
        and bool((variance >= 0).all()),
        path,
        f"{group} mean of {len(mean)} vertices, basis {matrix.shape}, {variance.size} variances",
        "(3n,), (3n, k), (k,) with no negative variance",
    )
    std = np.sqrt(variance)
    # statismo before 0.9 stored columns already multiplied by their standard deviation.
    norms = np.linalg.norm(basis.reshape(-1, len(std)), axis=0)
    scaled = norms.max(initial=0) > 1.05 and bool(np.allclose(norms, std, rtol=0.02))
    return mean, Modes(basis, std) if scaled else scaled_modes(basis, std)


def _dataset(file: Any, path: Path, name: str) -> np.ndarray:
    if name not in file:
        raise ModelFormatError(path, f"no dataset {name}", "the statismo layout")
    try:
        return np.asarray(file[name])
    except OSError as error:
        raise ModelFormatError(
            path, f"unreadable dataset {name} ({error})", "a whole file"
        ) from None


def _numbered_landmarks(file: Any, mean: Float[np.ndarray, "n 3"]) -> dict[str, int]:
    """Vertices nearest to the landmarks whose id is a number."""
    if "metadata/landmarks/json" not in file:
        return {}
    raw = np.asarray(file["metadata/landmarks/json"])
    text = raw.tobytes() if raw.dtype.kind in "iuS" else raw.ravel()[0]
    try:
        entries = json.loads(text.rstrip(b"\0") if isinstance(text, bytes) else text)
        pairs = [(str(entry["id"]), np.asarray(entry["coordinates"], float)) for entry in entries]
    except (ValueError, KeyError, TypeError):
        return {}  # landmarks are an extra: a model without readable ones is still a model
    return {
        key: int(np.argmin(np.sum((mean - position) ** 2, axis=1)))
        for key, position in pairs
        if key.isdecimal() and position.shape == (3,)
    }


def _read_mat(path: Path) -> dict[str, np.ndarray]:
    import h5py
    import scipy.io

    if h5py.is_hdf5(path):  # version 7.3 is HDF5, its axes in reverse
        with h5py.File(path, "r") as file:
            return {
                key: np.asarray(value).T
                for key, value in file.items()
                if isinstance(value, h5py.Dataset)
            }
    try:
        content = scipy.io.loadmat(path)
    except FileNotFoundError:
        raise
    except Exception as error:  # scipy's reader fails in many ways on a damaged file
        raise ModelFormatError(path, f"an unreadable file ({error})", "a MATLAB file") from error
    return {key: value for key, value in content.items() if not key.startswith("__")}


def _vector(values: Any) -> np.ndarray:
    return np.asarray(values, np.float64).ravel()


def _vertex_vector(path: Path | str, name: str, values: Any) -> np.ndarray:
    vector = _vector(values)
    require(
        vector.size % 3 == 0 and vector.size > 0, path, f"{name} of {vector.size} numbers", "3n"
    )
    return vector.reshape(-1, 3)
