"""Fitting a template mesh to a scan: non-rigid ICP.

On the host, in double precision, by sparse direct solves.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from jaxface._types import Bool, Float, Int
from jaxface.geometry.closest_point import TriangleTree
from jaxface.geometry.mesh import boundary_edges, edges

STIFFNESS = (50.0, 35.0, 20.0, 12.0, 7.0, 4.0, 2.0, 1.0, 0.5, 0.25)
"""default schedule; the distances it is weighed against are in units of 1/50 of the template"""


@dataclass(frozen=True)
class Registration:
    """A template deformed onto a scan."""

    vertices: Float[np.ndarray, "n 3"]
    """of the template, on the scan"""
    distance: Float[np.ndarray, "n"]
    """from each vertex to the scan's surface (the scan's units)"""
    matched: Bool[np.ndarray, "n"]
    """vertices that found a match in the last step"""


def non_rigid_icp(
    template: Float[np.ndarray, "n 3"],
    template_faces: Int[np.ndarray, "f 3"],
    scan: Float[np.ndarray, "m 3"],
    scan_faces: Int[np.ndarray, "g 3"],
    *,
    landmarks: Float[np.ndarray, "l n"] | sparse.spmatrix | None = None,
    landmark_targets: Float[np.ndarray, "l 3"] | None = None,
    landmark_weights: Sequence[float] = (20.0, 0.5),
    vertex_weights: Float[np.ndarray, "n"] | None = None,
    stiffness: Sequence[float] = STIFFNESS,
    steps: int = 4,
    skew: float = 1.0,
    reach: float | None = None,
    max_angle: float = 60.0,
    on_progress: Callable[[int, int], None] | None = None,
) -> Registration:
    """Deform a template onto a scan, from stiff to soft.

    Amberg, Romdhani and Vetter, "Optimal step nonrigid ICP algorithms for surface registration",
    CVPR 2007: every vertex has an affine transformation of its own; with the closest points held,
    distances + stiffness * differences along edges + landmarks is a sparse linear least-squares
    problem (its section 4), which is solved exactly.

    Args:
        template: vertices, roughly in place.
        template_faces: its triangles, counter-clockwise from outside.
        scan: vertices.
        scan_faces: its triangles, counter-clockwise from outside.
        landmarks: matrix whose rows combine template vertices into landmarks.
        landmark_targets: where those lie on the scan.
        landmark_weights: first and last weight of a landmark, falling geometrically.
        vertex_weights: of the distances; 0 for vertices the scan does not show.
        stiffness: alpha of each stage, falling.
        steps: closest-point searches in each stage.
        skew: gamma, weight of the translation-free part of a transformation (in lengths of the
            template's scale) against its translation.
        reach: closest points farther away are no matches (units); falls to a quarter by the last
            stage. By default 0.15 of the template's extent.
        max_angle: degrees between normals beyond which two points are no match.
        on_progress: called with (stage, stages).

    Raises:
        ValueError: shapes disagree, or the schedule is empty.
    """
    points = np.asarray(template, np.float64)
    faces = np.asarray(template_faces)
    count = len(points)
    if not len(stiffness):
        raise ValueError("stiffness is empty; at least one stage is needed")
    if (landmarks is None) != (landmark_targets is None):
        raise ValueError("landmarks and landmark_targets belong together; one of them is missing")
    if vertex_weights is not None and np.shape(vertex_weights) != (count,):
        raise ValueError(f"vertex_weights has shape {np.shape(vertex_weights)}; needs ({count},)")
    middle, extent = points.mean(0), float(np.max(np.ptp(points, axis=0)))
    unit = 50.0 / extent  # the schedule supposes a template 50 units large
    goal = (np.asarray(scan, np.float64) - middle) * unit
    tree = TriangleTree(goal, scan_faces)
    goal_normals = _face_normals(goal, np.asarray(scan_faces))
    rim = np.zeros(len(goal), bool)
    rim[boundary_edges(scan_faces).reshape(-1)] = True
    limit = (0.15 * extent if reach is None else reach) * unit
    start = (points - middle) * unit
    smooth, place = _stiffness_matrix(faces, count, skew), _positions_matrix(start)
    marks = None if landmarks is None else sparse.csr_matrix(landmarks) @ place
    targets = None if landmark_targets is None else (np.asarray(landmark_targets) - middle) * unit
    trust = np.ones(count) if vertex_weights is None else np.asarray(vertex_weights, np.float64)
    current, weight = start, np.zeros(count)
    decay = np.linspace(0, 1, len(stiffness)) if len(stiffness) > 1 else np.zeros(1)
    for stage, alpha in enumerate(stiffness):
        fixed = (alpha**2) * (smooth.T @ smooth)
        if marks is not None and targets is not None:
            first, last = landmark_weights
            beta = first * (last / first) ** decay[stage]
            fixed = fixed + beta**2 * (marks.T @ marks)
            pull = beta**2 * (marks.T @ targets)
        else:
            pull = np.zeros((4 * count, 3))
        for _ in range(steps):
            found = tree(current)
            normals = _vertex_normals(current, faces)
            facing = np.einsum("nd,nd->n", normals, goal_normals[found.triangle])
            weight = trust * (facing > np.cos(np.radians(max_angle)))
            weight = weight * (found.distance < limit * 0.25 ** decay[stage])
            # A match at the scan's rim belongs to a part of the template beyond the scan.
            corner = found.weights > 0.999
            edge = (rim[tree.faces[found.triangle]] & (found.weights > 1e-6)).sum(1)
            on_rim = (edge >= 2) & ((found.weights > 1e-6).sum(1) == 2) | (
                (corner & rim[tree.faces[found.triangle]]).any(1)
            )
            weight = weight * ~on_rim
            square = sparse.diags(weight**2)
            matrix = place.T @ square @ place + fixed
            right = place.T @ (square @ found.point) + pull
            # A whisper of ridge keeps vertices without triangles solvable.
            ridge = sparse.identity(4 * count) * 1e-9
            solved = _factored(matrix + ridge).solve(right)
            current = place @ solved
        if on_progress is not None:
            on_progress(stage + 1, len(stiffness))
    vertices = current / unit + middle
    distance = tree(current).distance / unit
    return Registration(vertices, distance, weight > 0)


def _factored(matrix: sparse.spmatrix) -> SuperLU:
    """A symmetric positive definite matrix, ordered for its own graph: no pivots are needed."""
    return splu(
        sparse.csc_matrix(matrix),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


def _stiffness_matrix(faces: np.ndarray, count: int, skew: float) -> sparse.csr_matrix:
    """``M (x) G``: differences of neighbours' transformations (the paper's stiffness term)."""
    pairs = edges(faces)
    row = np.repeat(np.arange(len(pairs)), 2)
    sign = np.tile([-1.0, 1.0], len(pairs))
    incidence = sparse.csr_matrix((sign, (row, pairs.reshape(-1))), (len(pairs), count))
    return sparse.csr_matrix(sparse.kron(incidence, sparse.diags([skew, skew, skew, 1.0])))


def _positions_matrix(points: np.ndarray) -> sparse.csr_matrix:
    """``D``: row i applies transformation i to vertex i in homogeneous coordinates."""
    count = len(points)
    values = np.concatenate([points, np.ones((count, 1))], axis=1)
    columns = 4 * np.arange(count)[:, None] + np.arange(4)
    rows = np.repeat(np.arange(count), 4)
    return sparse.csr_matrix((values.reshape(-1), (rows, columns.reshape(-1))), (count, 4 * count))


def _face_normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (points[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)


def _vertex_normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (points[faces[:, k]] for k in range(3))
    area = np.cross(b - a, c - a)
    total = np.zeros_like(points)
    for k in range(3):
        np.add.at(total, faces[:, k], area)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)
