"""A model's topology on a head scan: its likeliest face, then a registration without one."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from jaxface._types import Float
from jaxface.geometry.registration import Registration, non_rigid_icp
from jaxface.geometry.rotation import similarity_transform
from jaxface.models.landmark_schemes import FACE_OVAL, JAW_68
from jaxface.models.morphable import MorphableModel, SurfacePoints
from jaxface.models.regions import FACE_REGIONS, in_regions
from jaxface.models.skin.regions import skin_fields
from jaxface.stages.scan.head_scan import HeadScan

_LANDMARK_STD = 3.0
"""mm, of a detected point of the face"""
_STIFFNESS = (50.0, 35.0, 25.0, 18.0, 12.0, 8.0, 5.0, 3.0, 2.0)


@dataclass(frozen=True)
class RegisteredScan:
    """A scan, and a model's topology on it."""

    scan: HeadScan
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


def register_topology(
    scan: HeadScan,
    marks: Float[np.ndarray, "l 3"],
    model: MorphableModel,
    *,
    on_progress: Callable[[int, int], None] | None = None,
) -> RegisteredScan:
    """Lay a model's topology over a head scan.

    The identity and the similarity that bring the model's landmarks nearest to the scan's, then
    non-rigid ICP from there.

    Args:
        scan: in any units.
        marks: the 68 or 468 points on it, in its units.
        model: the topology.
        on_progress: called with (stage, stages) of the registration.

    Raises:
        ValueError: the model has no landmarks of that number.
    """
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
    face = np.isin(used, np.flatnonzero(in_regions(model, FACE_REGIONS)))
    return RegisteredScan(scan, vertices, placed, scale, error, found.distance[face])


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
    placement = similarity_transform(marks[trusted], mean[trusted])
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
        placement = similarity_transform(marks[good], (mean + columns @ z)[good])
    shape = np.asarray(model.mean, np.float64) + basis @ z
    scale, rotation, shift = placement
    return shape, float(scale), np.asarray(rotation), np.asarray(shift), inlier > 0.3


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
