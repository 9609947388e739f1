"""From a file's arrays to a `MorphableModel`: checks, orientation, and what a format lacks."""

from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxface._types import Float, Int
from jaxface.io.face_models.cylinder import cylindrical_uv
from jaxface.io.face_models.skin import generic_skin
from jaxface.models.linear import LinearBasis, empty_basis
from jaxface.models.morphable import MorphableModel, SurfacePoints
from jaxface.models.regions import REGIONS, label_regions

BLENDSHAPE_STD = 0.5
"""standard deviation given to blendshape weights, which come without statistics: the full
expression, weight one, is then a 2-sigma event, as in the bundled model"""


class ModelFormatError(ValueError):
    """A model file is not what its loader needs; says which file, what was found and needed."""

    def __init__(self, path: str | Path, found: str, needed: str) -> None:
        super().__init__(f"{path}: found {found}; needed {needed}")
        self.path = Path(path)


@dataclass
class Modes:
    """A linear basis as the file gives it, already scaled to one standard deviation a column."""

    basis: Float[np.ndarray, "n 3 k"]
    std: Float[np.ndarray, "k"]


@dataclass
class SourceModel:
    """What a loader found in a file, in the package's frame and units (mm, +y up, +z forward)."""

    path: Path
    name: str
    licence: str
    mean: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "f 3"]
    identity: Modes
    expression: Modes | None = None
    expression_names: tuple[str, ...] = ()
    albedo_mean: Float[np.ndarray, "n 3"] | None = None
    albedo: Modes | None = None
    uv: Float[np.ndarray, "m 2"] | None = None
    uv_faces: Int[np.ndarray, "f 3"] | None = None
    quads: Int[np.ndarray, "q 4"] | None = None
    uv_quads: Int[np.ndarray, "q 4"] | None = None
    landmarks68: SurfacePoints | None = None
    region: Int[np.ndarray, "n"] | None = None
    region_names: tuple[str, ...] = ("head",)


def require(condition: bool, path: str | Path, found: str, needed: str) -> None:
    """Raise a `ModelFormatError` unless ``condition`` holds."""
    if not condition:
        raise ModelFormatError(path, found, needed)


def vertex_major(
    path: str | Path, name: str, matrix: np.ndarray, columns: int | None = None
) -> np.ndarray:
    """A ``(3n, k)`` matrix of x y z x y z ... rows as ``(n, 3, k)`` float32.

    Raises:
        ModelFormatError: not two-dimensional, rows not a multiple of three, or not ``columns``.
    """
    matrix = np.asarray(matrix)
    columns_wanted = "k" if columns is None else str(columns)
    fits = matrix.ndim == 2 and matrix.shape[0] % 3 == 0 and matrix.dtype.kind in "fiu"
    require(
        fits and (columns is None or matrix.shape[1] == columns),
        path,
        f"{name} of shape {matrix.shape} and type {matrix.dtype}",
        f"numbers of shape (3n, {columns_wanted})",
    )
    return matrix.astype(np.float32, copy=False).reshape(-1, 3, matrix.shape[1])


def scaled_modes(basis: Float[np.ndarray, "n 3 k"], std: Float[np.ndarray, "k"]) -> Modes:
    """Unit-length modes times their standard deviations."""
    return Modes(basis * std.astype(basis.dtype), std)


def outward(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"]) -> np.ndarray:
    """The triangles, all reversed if they are clockwise seen from outside.

    The flux of ``x - c`` through the surface has the sign of the orientation, for a closed head
    whatever ``c`` is, and for an open face with ``c`` behind it.
    """
    behind = np.array([vertices[:, 0].mean(), vertices[:, 1].mean(), vertices[:, 2].min()])
    a, b, c = (vertices[faces[:, corner]] - behind for corner in range(3))
    flux = np.sum(np.einsum("fi,fi->f", a, np.cross(b, c)))
    return faces if flux >= 0 else np.ascontiguousarray(faces[:, ::-1])


def assemble(source: SourceModel) -> MorphableModel:
    """Check a source model and fill in what its format lacks.

    Without UVs a cylindrical projection is made (`cylindrical_uv`), without an albedo a generic
    skin (`generic_skin`), without expressions an empty basis, without regions but with landmarks
    those of `label_regions`. Triangles are turned outward.

    Raises:
        ModelFormatError: shapes disagree, an index is out of range, or a value is not finite.
    """
    path, count = source.path, len(source.mean)
    _check_mesh(source)
    expression = source.expression or Modes(np.zeros((count, 3, 0)), np.zeros(0))
    _check_modes(path, "identity", source.identity, count)
    _check_modes(path, "expression", expression, count)
    names = source.expression_names or tuple(
        f"expression{i:03d}" for i in range(len(expression.std))
    )
    require(
        len(names) == len(expression.std),
        path,
        f"{len(names)} expression names for {len(expression.std)} modes",
        "one name a mode",
    )
    faces = outward(source.mean, source.faces)
    flipped = faces is not source.faces
    uv, uv_faces = source.uv, source.uv_faces
    if uv is None:
        uv, uv_faces = cylindrical_uv(source.mean, faces)
    elif uv_faces is None:
        uv_faces = faces
    elif flipped:
        uv_faces = np.ascontiguousarray(uv_faces[:, ::-1])
    albedo_mean, albedo = source.albedo_mean, source.albedo
    points = landmark_positions(source.mean, source.landmarks68)
    if albedo_mean is None:
        albedo_mean, basis, std = generic_skin(source.mean, points)
        albedo = Modes(basis, std)
    albedo = albedo or Modes(np.zeros((count, 3, 0)), np.zeros(0))
    _check_modes(path, "albedo", albedo, count)
    require(
        albedo_mean.shape == (count, 3) and bool(np.all(np.isfinite(albedo_mean))),
        path,
        f"mean albedo of shape {albedo_mean.shape}",
        f"finite numbers of shape ({count}, 3)",
    )
    region, region_names = source.region, source.region_names
    if points is not None and region is None:
        region, region_names = label_regions(source.mean, faces, points), REGIONS
    elif region is None:
        region = np.zeros(count, np.int32)
    quads, uv_quads = source.quads, source.uv_quads
    if quads is not None and flipped:
        quads, uv_quads = _reversed_quads(quads), _reversed_quads(uv_quads)
    return MorphableModel(
        mean=jnp.asarray(source.mean, jnp.float32),
        identity=_linear(source.identity),
        expression=_linear(expression) if len(expression.std) else empty_basis(count),
        albedo_mean=jnp.asarray(albedo_mean, jnp.float32),
        albedo=_linear(albedo),
        faces=jnp.asarray(faces, jnp.int32),
        uv=jnp.asarray(uv, jnp.float32),
        uv_faces=jnp.asarray(uv_faces, jnp.int32),
        landmarks68=source.landmarks68,
        landmarks468=None,
        region=jnp.asarray(region, jnp.int32),
        name=source.name,
        region_names=region_names,
        expression_names=tuple(names),
        licence=source.licence,
        quads=None if quads is None else jnp.asarray(quads, jnp.int32),
        uv_quads=None if uv_quads is None else jnp.asarray(uv_quads, jnp.int32),
    )


def landmark_positions(
    mean: Float[np.ndarray, "n 3"], points: SurfacePoints | None
) -> Float[np.ndarray, "l 3"] | None:
    """Positions of landmarks on a shape (mm), None without landmarks."""
    if points is None:
        return None
    return np.einsum("li,lic->lc", np.asarray(points.weights), mean[np.asarray(points.vertices)])


def _linear(modes: Modes) -> LinearBasis:
    return LinearBasis(jnp.asarray(modes.basis, jnp.float32), jnp.asarray(modes.std, jnp.float32))


def _reversed_quads(quads: np.ndarray | None) -> np.ndarray | None:
    if quads is None:
        return None
    triangle = quads[:, 3] < 0
    turned = quads[:, ::-1].copy()
    turned[triangle, :3], turned[triangle, 3] = quads[triangle, 2::-1], -1
    return turned


def _check_mesh(source: SourceModel) -> None:
    path, mean, faces = source.path, source.mean, source.faces
    require(
        mean.ndim == 2 and mean.shape[1:] == (3,) and len(mean) >= 3,
        path,
        f"mean shape of shape {mean.shape}",
        "(n, 3) with at least three vertices",
    )
    require(bool(np.all(np.isfinite(mean))), path, "a mean shape with NaN or Inf", "finite numbers")
    require(
        faces.ndim == 2 and faces.shape[1:] == (3,) and len(faces) > 0,
        path,
        f"triangles of shape {faces.shape}",
        "(f, 3), at least one",
    )
    tables = [("triangle", faces, len(mean)), ("quad", source.quads, len(mean))]
    if source.uv is not None:
        require(
            source.uv.ndim == 2 and source.uv.shape[1] == 2 and bool(np.isfinite(source.uv).all()),
            path,
            f"texture coordinates of shape {source.uv.shape}",
            "finite numbers of shape (m, 2)",
        )
        tables += [
            ("texture triangle", source.uv_faces, len(source.uv)),
            ("texture quad", source.uv_quads, len(source.uv)),
        ]
        if source.uv_faces is None:
            require(
                len(source.uv) == len(mean),
                path,
                f"{len(source.uv)} texture coordinates without triangles of their own",
                f"{len(mean)}, one a vertex",
            )
        else:
            require(
                source.uv_faces.shape == faces.shape,
                path,
                f"texture triangles of shape {source.uv_faces.shape}",
                f"{faces.shape}",
            )
    for what, table, limit in tables:
        if table is not None:
            low, high = int(table.min()), int(table.max())
            lowest = -1 if "quad" in what else 0
            require(
                low >= lowest and high < limit,
                path,
                f"{what} indices from {low} to {high}",
                f"indices from 0 to {limit - 1}",
            )
    points = source.landmarks68
    if points is not None:
        high, low = int(points.vertices.max()), int(points.vertices.min())
        require(
            points.vertices.shape == (68, 3) and low >= 0 and high < len(mean),
            path,
            f"landmarks {points.vertices.shape} on vertices {low} to {high}",
            f"68 points on vertices 0 to {len(mean) - 1}",
        )


def _check_modes(path: Path, name: str, modes: Modes, count: int) -> None:
    basis, std = modes.basis, modes.std
    require(
        basis.ndim == 3 and basis.shape[:2] == (count, 3) and std.shape == basis.shape[2:],
        path,
        f"{name} basis of shape {basis.shape} with {std.shape} standard deviations",
        f"({count}, 3, k) with k",
    )
    require(
        bool(np.all(np.isfinite(basis)) and np.all(np.isfinite(std)) and np.all(std >= 0)),
        path,
        f"{name} basis with NaN, Inf or a negative standard deviation",
        "finite numbers",
    )
