"""The Surrey Face Model, and any other model, as the eos library stores it (``.bin``).

Huber et al., "A Multiresolution 3D Morphable Face Model and Fitting Framework", VISAPP 2016.
Units millimetres, +y up, +z forward; colours sRGB in [0, 1]; bases orthonormal with variances.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxface.io.face_models.assemble import (
    BLENDSHAPE_STD,
    Modes,
    SourceModel,
    assemble,
    require,
    scaled_modes,
    vertex_major,
)
from jaxface.io.face_models.cereal import CerealReader
from jaxface.io.face_models.colour import linear_albedo
from jaxface.io.face_models.landmarks import read_landmarks68
from jaxface.models.morphable import MorphableModel

_LICENCE = (
    "Surrey Face Model (Huber et al. 2016), University of Surrey: licensed to its holder, "
    "see cvssp.org/facemodel"
)


@dataclass
class _Pca:
    """eos's ``PcaModel``: mean (3n,), orthonormal basis (3n, k), variances (k,), triangles."""

    mean: np.ndarray
    basis: np.ndarray
    variance: np.ndarray
    triangles: np.ndarray

    @property
    def std(self) -> np.ndarray:
        return np.sqrt(self.variance.astype(np.float64))


@dataclass
class _Blendshapes:
    """eos's ``Blendshapes``: names and deformations (3n, k)."""

    names: tuple[str, ...]
    basis: np.ndarray


def _read_pca(archive: CerealReader, what: str) -> _Pca:
    mean = archive.matrix(f"{what} mean")
    basis = archive.matrix(f"{what} basis")
    variance = archive.matrix(f"{what} variances")
    triangles = archive.arrays("<i4", 3, f"{what} triangles")
    require(
        mean.size == basis.shape[0] and variance.size == basis.shape[1],
        archive.path,
        f"{what} with mean {mean.shape}, basis {basis.shape}, variances {variance.shape}",
        "mean (3n, 1), basis (3n, k), variances (k, 1)",
    )
    require(
        bool(np.all(variance >= 0)), archive.path, f"a negative {what} variance", "none below 0"
    )
    return _Pca(mean.ravel(), basis, variance.ravel(), triangles)


def _read_blendshapes(archive: CerealReader) -> _Blendshapes:
    names, columns = [], []
    for index in range(archive.number("Q", "count of blendshapes")):
        names.append(archive.text(f"name of blendshape {index}"))
        columns.append(archive.matrix(f"blendshape {index}").ravel())
    sizes = {column.size for column in columns}
    require(
        len(sizes) <= 1, archive.path, f"blendshapes of sizes {sorted(sizes)}", "one common size"
    )
    return _Blendshapes(tuple(names), np.stack(columns, axis=1) if columns else np.zeros((0, 0)))


def load_surrey(
    path: str | Path,
    *,
    blendshapes: str | Path | None = None,
    landmarks: str | Path | None = None,
    contours: str | Path | None = None,
) -> MorphableModel:
    """Load a model in eos's binary format, class versions 1 to 4.

    Blendshapes carry no statistics: their weights get a standard deviation of `BLENDSHAPE_STD`.

    Args:
        path: e.g. ``sfm_shape_3448.bin``.
        blendshapes: e.g. ``expression_blendshapes_3448.bin``, for a model without expressions.
        landmarks: eos's mapping of the 68 points, e.g. ``ibug_to_sfm.txt``; defaults to the
            landmark definitions in the model, where it has them.
        contours: eos's ``sfm_model_contours.json``: fills the jaw line that the mapping lacks.

    Raises:
        ValueError: not such a file, or its parts disagree.
    """
    archive = CerealReader(path)
    version = archive.number("I", "class version")
    require(
        1 <= version <= 4,
        path,
        f"class version {version}",
        "an eos model of class version 1 to 4 (the first four bytes of the file)",
    )
    shape = _read_pca(archive, "shape model")
    colour = _read_pca(archive, "colour model")
    expression: _Pca | _Blendshapes | None = None
    if version >= 2 and archive.has_value("expression model"):
        kind = archive.number("i", "kind of expression model")
        require(
            kind in (0, 1), path, f"expression model of kind {kind}", "0 (PCA) or 1 (blendshapes)"
        )
        expression = (
            _read_pca(archive, "expression model") if kind == 0 else _read_blendshapes(archive)
        )
    definitions: dict[str, int] = {}
    if version >= 3 and archive.has_value("landmark definitions"):
        for _ in range(archive.number("Q", "count of landmark definitions")):
            key = archive.text("landmark name")
            definitions[key] = archive.number("i", f"vertex of landmark {key}")
    uv = archive.arrays("<f8", 2, "texture coordinates")
    uv_faces = archive.arrays("<i4", 3, "texture triangles") if version >= 4 else np.zeros((0, 3))
    archive.finish()
    if expression is None and blendshapes is not None:
        archive = CerealReader(blendshapes)
        expression = _read_blendshapes(archive)
        archive.finish()

    mean = shape.mean.astype(np.float64).reshape(-1, 3)
    basis = vertex_major(path, "shape basis", shape.basis)
    modes, names = None, ()
    if isinstance(expression, _Pca):
        require(
            expression.mean.size == shape.mean.size,
            path,
            f"an expression model of {expression.mean.size // 3} vertices",
            f"{len(mean)}",
        )
        mean = mean + expression.mean.reshape(-1, 3)
        modes = scaled_modes(
            vertex_major(path, "expression basis", expression.basis), expression.std
        )
    elif expression is not None and expression.names:
        deformations = vertex_major(blendshapes or path, "blendshapes", expression.basis)
        modes = Modes(deformations * BLENDSHAPE_STD, np.full(len(expression.names), BLENDSHAPE_STD))
        names = expression.names
    albedo_mean = albedo = None
    if colour.mean.size:
        albedo_mean, albedo = linear_albedo(
            colour.mean.reshape(-1, 3), vertex_major(path, "colour basis", colour.basis), colour.std
        )
    faces = shape.triangles
    return assemble(
        SourceModel(
            path=Path(path),
            name=Path(path).stem,
            licence=_LICENCE,
            mean=mean,
            faces=faces,
            identity=scaled_modes(basis, shape.std),
            expression=modes,
            expression_names=tuple(names),
            albedo_mean=albedo_mean,
            albedo=albedo,
            # eos counts v from the top of the texture, as image rows.
            uv=np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=1) if len(uv) else None,
            uv_faces=uv_faces.astype(np.int32) if len(uv) and len(uv_faces) else None,
            landmarks68=read_landmarks68(
                landmarks, faces, len(mean), contours=contours, definitions=definitions
            ),
        )
    )
