"""A head scan into a model's topology and UVs: landmarks, registration, transfer of its maps."""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from scipy import sparse

from jaxface._types import Float
from jaxface.geometry.closest_point import TriangleTree
from jaxface.geometry.registration import Registration, non_rigid_icp, similarity
from jaxface.geometry.uv import UVLayout, uv_layout
from jaxface.imaging.colour import srgb_to_linear
from jaxface.imaging.resample import resize
from jaxface.io.face_models import load_model
from jaxface.io.formats.image import read_image
from jaxface.io.formats.landmark_file import read_landmarks
from jaxface.io.formats.obj import ObjMesh, read_obj
from jaxface.io.texture_database import TextureDatabase
from jaxface.models.landmark_schemes import FACE_OVAL, JAW_68
from jaxface.models.linear import LinearBasis, empty_basis
from jaxface.models.morphable import MorphableModel, SurfacePoints
from jaxface.models.regions import FACE_REGIONS
from jaxface.models.skin.regions import skin_fields
from jaxface.pipeline.databases.embedding import embed_landmarks
from jaxface.pipeline.databases.makehuman import whole_texture
from jaxface.stages.scan.transfer import (
    TransferredTexture,
    resample_texture,
    texel_colours,
)

_HEIGHT = 280.0
"""mm, first guess of a scan's height, for the landmark detector"""
_LANDMARK_STD = 3.0
"""mm, of a detected point of the face"""
_STIFFNESS = (50.0, 35.0, 25.0, 18.0, 12.0, 8.0, 5.0, 3.0, 2.0)
_COLOUR_SIDE = 512
"""px, to which an albedo is reduced before it colours vertices"""


@dataclass(frozen=True)
class RegisteredScan:
    """A scan, and a model's topology on it."""

    scan: ObjMesh
    vertices: Float[np.ndarray, "n 3"]
    """of the model, on the scan (mm, the model's frame); NaN where the model has no skin"""
    scan_vertices: Float[np.ndarray, "m 3"]
    """of the scan in that frame (mm)"""
    scale: float
    """mm per unit of the scan, found by the landmarks"""
    landmark_error: Float[np.ndarray, "l"]
    """mm, from the model's landmarks to the scan's after registration"""
    distance: Float[np.ndarray, "k"]
    """mm, from the model's face vertices to the scan's surface"""

    def summary(self) -> dict[str, float]:
        """Median, 95th percentile and largest distance, and the median landmark error (mm)."""
        return {
            "median_mm": float(np.median(self.distance)),
            "p95_mm": float(np.quantile(self.distance, 0.95)),
            "largest_mm": float(self.distance.max()),
            "landmarks_mm": float(np.median(self.landmark_error)),
            "mm_per_unit": self.scale,
        }


def register_scan(
    mesh: str | os.PathLike[str],
    albedo: str | os.PathLike[str] | None = None,
    *,
    model: MorphableModel | None = None,
    landmarks: str | os.PathLike[str] | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> RegisteredScan:
    """Lay a model's topology over a head scan.

    The scan must stand upright and look along +z; its units do not matter.

    Args:
        mesh: OBJ with texture coordinates.
        albedo: the scan's colour map; the detector needs it to find the landmarks.
        model: the topology, by default the bundled model's.
        landmarks: file of 68 or 468 points (x, y, z in the scan's units), instead of detection.
        on_progress: called with (stage, stages) of the registration.

    Raises:
        FileNotFoundError: a file is absent.
        ValueError: the scan has no texture coordinates, or its landmarks cannot be found.
    """
    scan = read_obj(Path(mesh))
    _texture_coordinates(scan)
    model = load_model("makehuman") if model is None else model
    if landmarks is not None:
        given = read_landmarks(landmarks)
        if given.points.shape[1] != 3:
            raise ValueError(f"{landmarks} holds points of the plane; x, y, z are needed")
        marks = np.asarray(given.points, np.float64)
    else:
        marks = _detected(scan, albedo)
    points = model.landmarks468 if len(marks) == 468 else model.landmarks68
    if points is None:
        raise ValueError(f"model {model.name!r} has no {len(marks)} landmarks")
    combine = _matrix(points, model.vertex_count)
    # Points of the outline are where a view ended, not places of the skin.
    outline = FACE_OVAL if len(marks) == 468 else JAW_68
    trusted = ~np.isin(np.arange(len(marks)), list(outline))
    start, scale, rotation, shift, inlier = _likely_shape(model, points, marks, trusted)
    placed = scale * scan.vertices @ rotation.T + shift
    targets = scale * marks @ rotation.T + shift
    fields = skin_fields(model)
    skin = np.asarray(fields.regions.skin) > 0
    kept, used = _cut(np.asarray(model.faces), skin)
    own = sparse.csr_matrix(combine[:, used])
    whole = (np.asarray(own.sum(1)).ravel() > 0.999) & inlier
    ears = np.asarray(fields.regions.ear)[used]
    found: Registration = non_rigid_icp(
        start[used], kept, placed, scan.faces, landmarks=own[whole],
        landmark_targets=targets[whole], stiffness=_STIFFNESS,
        vertex_weights=np.clip(1 - 1.5 * ears, 0, 1), reach=25.0, max_angle=50.0,
        on_progress=on_progress,
    )  # fmt: skip
    vertices = np.full((model.vertex_count, 3), np.nan)
    vertices[used] = found.vertices
    error = np.linalg.norm(own[whole] @ found.vertices - targets[whole], axis=1)
    face = np.isin(used, np.flatnonzero(_face(model)))
    return RegisteredScan(scan, vertices, placed, scale, error, found.distance[face])


def transfer(
    registered: RegisteredScan,
    texture: Float[np.ndarray, "h w c"],
    model: MorphableModel,
    layout: UVLayout,
    reach: float = 3.0,
) -> TransferredTexture:
    """A map of the scan in the model's UVs, by the closest point of the scan to each texel.

    Args:
        registered: the scan.
        texture: any map in the scan's UVs (linear values).
        model: the topology.
        layout: of the model.
        reach: mm; texels farther from the scan are unknown.

    Returns:
        A `TransferredTexture`.
    """
    scan = registered.scan
    scan_uv, scan_uv_faces = _texture_coordinates(scan)
    at = np.asarray(layout(jnp.asarray(registered.vertices, jnp.float32), model.faces, jnp.nan))
    shown = np.isfinite(at).all(-1)
    tree = TriangleTree(registered.scan_vertices, scan.faces)
    found = tree(at[shown])
    corners = scan_uv[scan_uv_faces[found.triangle]]
    uv = np.einsum("qi,qid->qd", found.weights, corners)
    source_uv = np.full((*shown.shape, 2), np.nan, np.float32)
    source_uv[shown] = np.where(found.distance[:, None] < reach, uv, np.nan)
    known = jnp.ones(texture.shape[:2], bool)
    return resample_texture(jnp.asarray(texture), known, jnp.asarray(source_uv), layout)


def import_scan(
    mesh: str | os.PathLike[str],
    albedo: str | os.PathLike[str],
    out: str | os.PathLike[str],
    resolution: int = 1024,
    *,
    subject: str,
    licence: str,
    landmarks: str | os.PathLike[str] | None = None,
    attributes: Mapping[str, object] | None = None,
    name: str = "scans",
    credits: tuple[str, ...] = (),
    on_progress: Callable[[int, int], None] | None = None,
) -> tuple[TextureDatabase, RegisteredScan]:
    """Register a scan and add its albedo to a database.

    Args:
        mesh: OBJ of a head with texture coordinates.
        albedo: its colour map (sRGB-encoded).
        out: folder of the database, new or begun.
        resolution: texels along a side.
        subject: its name in the database.
        licence: of the scan, with its credit.
        landmarks: see `register_scan`.
        attributes: recorded with the subject.
        name: of a new database.
        credits: lines added to the database's; by default the licence.
        on_progress: called with (stage, stages) of the registration.

    Raises:
        FileNotFoundError: a file is absent.
        ValueError: as `register_scan` and `TextureDatabase.create`.
    """
    model = load_model("makehuman")
    database = TextureDatabase.create(
        out, model, resolution, name=name, licence=licence, credits=credits or (licence,)
    )
    registered = register_scan(
        mesh, albedo, model=model, landmarks=landmarks, on_progress=on_progress
    )
    layout = uv_layout(model.uv, model.uv_faces, resolution)
    linear = np.asarray(srgb_to_linear(jnp.asarray(read_image(albedo).pixels)))
    found = transfer(registered, linear, model, layout)
    texture = np.asarray(whole_texture(found, model, layout))
    record = {"file": Path(albedo).name, **registered.summary(), **dict(attributes or {})}
    database.write_subject(subject, texture, licence=licence, attributes=record)
    return database, registered


def _texture_coordinates(scan: ObjMesh) -> tuple[np.ndarray, np.ndarray]:
    if scan.uv is None or scan.uv_faces is None:
        raise ValueError("the scan has no texture coordinates; a textured OBJ is needed")
    return np.asarray(scan.uv), scan.uv_faces


def _detected(scan: ObjMesh, albedo: str | os.PathLike[str] | None) -> np.ndarray:
    """The 468 points on the scan (its units), found on renders of it."""
    if albedo is None:
        raise ValueError("finding landmarks needs the scan's albedo (or give a landmark file)")
    pixels = jnp.asarray(read_image(albedo).pixels)
    small = resize(pixels, _COLOUR_SIDE, _COLOUR_SIDE)
    vertices = scan.vertices
    middle = 0.5 * (vertices.min(0) + vertices.max(0))
    scale = _HEIGHT / np.ptp(vertices[:, 1])
    scan_uv, scan_uv_faces = _texture_coordinates(scan)
    corner = np.zeros(len(vertices), np.int64)
    corner[scan.faces.reshape(-1)] = scan_uv_faces.reshape(-1)
    colour = srgb_to_linear(texel_colours(small, jnp.asarray(scan_uv[corner], jnp.float32)))
    count = len(vertices)
    stand_in = MorphableModel(
        mean=jnp.asarray((vertices - middle) * scale, jnp.float32),
        identity=empty_basis(count),
        expression=empty_basis(count),
        albedo_mean=colour,
        albedo=LinearBasis(jnp.zeros((count, 3, 0)), jnp.zeros(0)),
        faces=jnp.asarray(scan.faces, jnp.int32),
        uv=jnp.asarray(scan_uv, jnp.float32),
        uv_faces=jnp.asarray(scan_uv_faces, jnp.int32),
        landmarks68=None,
        landmarks468=None,
        region=jnp.zeros(count, jnp.int32),
        name="scan",
        region_names=("face",),
        expression_names=(),
        licence="",
    )
    found = embed_landmarks(stand_in)
    return np.asarray(found.points(stand_in.mean), np.float64) / scale + middle


def _likely_shape(
    model: MorphableModel, points: SurfacePoints, marks: np.ndarray, trusted: np.ndarray
) -> tuple[np.ndarray, float, np.ndarray, np.ndarray, np.ndarray]:
    """The model's identity nearest to the landmarks, the scan's place in its frame, the inliers.

    Identity and similarity in turn: ridge regression of the coefficients with a unit Gaussian
    prior and landmarks good to `_LANDMARK_STD`, each weighted by how well it agrees so far
    (Geman and McClure's robust weights).
    """
    count = model.identity.count
    basis = np.asarray(model.identity.basis, np.float64)
    corners, weights = np.asarray(points.vertices), np.asarray(points.weights, np.float64)
    columns = np.einsum("li,lick->lck", weights, basis[corners])
    mean = np.einsum("li,lic->lc", weights, np.asarray(model.mean, np.float64)[corners])
    z, inlier = np.zeros(count), trusted.astype(np.float64)
    placement = similarity(marks[trusted], mean[trusted])
    for _ in range(12):
        scale, rotation, shift = placement
        placed = scale * marks @ rotation.T + shift
        error = np.sum((mean + columns @ z - placed) ** 2, axis=1)
        inlier = trusted / (1 + error / (3 * _LANDMARK_STD) ** 2) ** 2
        root = np.sqrt(inlier)[:, None] / _LANDMARK_STD
        a = (columns * root[..., None]).reshape(-1, count)
        b = ((placed - mean) * root).reshape(-1)
        z = np.linalg.solve(a.T @ a + np.eye(count), a.T @ b)
        good = inlier > 0.3
        placement = similarity(marks[good], (mean + columns @ z)[good])
    shape = np.asarray(model.mean, np.float64) + basis @ z
    return shape, *placement, inlier > 0.3


def _matrix(points: SurfacePoints, count: int) -> sparse.csr_matrix:
    vertices, weights = np.asarray(points.vertices), np.asarray(points.weights, np.float64)
    rows = np.repeat(np.arange(len(vertices)), 3)
    shape = (len(vertices), count)
    return sparse.csr_matrix((weights.reshape(-1), (rows, vertices.reshape(-1))), shape)


def _cut(faces: np.ndarray, kept: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles whose corners are all kept, renumbered, and the vertices they use."""
    inside = faces[kept[faces].all(axis=1)]
    used, renumbered = np.unique(inside, return_inverse=True)
    return renumbered.reshape(-1, 3).astype(np.int32), used


def _face(model: MorphableModel) -> np.ndarray:
    known = [name for name in FACE_REGIONS if name in model.region_names]
    return np.asarray(model.region_mask(*known)) if known else np.ones(model.vertex_count, bool)
