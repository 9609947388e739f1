"""Subdivision surfaces as sparse matrices: Catmull-Clark for quads, Loop for triangles.

Both schemes are linear in the vertices, so one matrix refines a mean shape and every basis
column alike and coefficients keep their meaning. NumPy and SciPy only: topology is built once,
outside of any traced function.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Int
from scipy import sparse


class Refinement(NamedTuple):
    """One level of subdivision of a mesh."""

    matrix: sparse.csr_matrix
    """(refined vertices, vertices): rows are affine weights"""
    linear: sparse.csr_matrix
    """the same vertices merely interpolated (midpoints, face means): for UV coordinates, whose
    seams must stay where they are on both sides"""
    quads: Int[np.ndarray, "q 4"]
    """refined quads; 4th index -1 for a triangle (Loop gives triangles only)"""
    parent: Int[np.ndarray, "q"]
    """the face of the coarse mesh that each refined face came from"""


class _Edges(NamedTuple):
    pairs: np.ndarray  # (e, 2) vertices, ascending
    of_corner: np.ndarray  # (corners,) edge that leaves each face corner
    faces: np.ndarray  # (e,) number of faces at each edge


def _corners(quads: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Per valid face corner: face, vertex, next vertex, previous corner (index into corners)."""
    valid = quads >= 0
    size = valid.sum(1)
    face, slot = np.nonzero(valid)
    number = np.full(quads.shape, -1)
    number[valid] = np.arange(len(face))
    following = quads[face, (slot + 1) % size[face]]
    previous = number[face, (slot - 1) % size[face]]
    return face, quads[face, slot], following, previous


def _checked(quads: np.ndarray, vertex_count: int) -> np.ndarray:
    quads = np.asarray(quads)
    if quads.ndim != 2 or quads.shape[1] not in (3, 4):
        raise ValueError(f"faces need shape (q, 3) or (q, 4), got {quads.shape}")
    if quads.shape[1] == 3:
        quads = np.concatenate([quads, np.full((len(quads), 1), -1)], axis=1)
    if len(quads) == 0 or quads[:, :3].min() < 0 or quads[:, 3].min() < -1:
        raise ValueError("faces need at least one face and indices >= 0 (-1 only as 4th)")
    if quads.max() >= vertex_count:
        raise ValueError(f"faces index vertex {quads.max()} of a mesh of {vertex_count} vertices")
    return quads


def _edges(vertex: np.ndarray, following: np.ndarray) -> _Edges:
    pairs = np.sort(np.stack([vertex, following], axis=1), axis=1)
    unique, of_corner, counts = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
    if counts.max() > 2:
        worst = unique[counts.argmax()]
        raise ValueError(
            f"edge {worst.tolist()} belongs to {counts.max()} faces; subdivision needs at most 2"
        )
    return _Edges(unique, of_corner.reshape(-1), counts)


def _matrix(
    entries: list[tuple[np.ndarray, np.ndarray, np.ndarray]], shape: tuple[int, int]
) -> sparse.csr_matrix:
    """Sum of (rows, columns, values) entries."""
    rows, columns, values = (np.concatenate(x) for x in zip(*entries, strict=True))
    matrix = sparse.csr_matrix((values, (rows, columns)), shape)
    matrix.sum_duplicates()
    return matrix


def _midpoints(edges: _Edges, vertex_count: int) -> sparse.csr_matrix:
    count = len(edges.pairs)
    rows = np.repeat(np.arange(count), 2)
    return sparse.csr_matrix(
        (np.full(2 * count, 0.5), (rows, edges.pairs.ravel())), (count, vertex_count)
    )


def _boundary_rule(
    edges: _Edges, vertex_count: int
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Boundary vertices and their refinement as a cubic B-spline curve: (1, 6, 1) / 8.

    A vertex where several boundary curves meet stays fixed.

    Returns:
        Mask of the boundary vertices, and their (rows, columns, values).
    """
    border = edges.pairs[edges.faces == 1]
    degree = np.bincount(border.ravel(), minlength=vertex_count)
    fixed = (degree > 0) & (degree != 2)
    tail, head = np.concatenate([border, border[:, ::-1]]).T
    smooth = ~fixed[tail]
    on_curve = np.flatnonzero((degree > 0) & ~fixed)
    entries = (
        np.concatenate([tail[smooth], on_curve, np.flatnonzero(fixed)]),
        np.concatenate([head[smooth], on_curve, np.flatnonzero(fixed)]),
        np.concatenate(
            [np.full(smooth.sum(), 0.125), np.full(len(on_curve), 0.75), np.ones(fixed.sum())]
        ),
    )
    return degree > 0, entries


def catmull_clark(quads: Int[np.ndarray, "q 4"], vertex_count: int) -> Refinement:
    """One level of Catmull-Clark subdivision with smooth boundary curves.

    Catmull & Clark, "Recursively generated B-spline surfaces on arbitrary topological meshes",
    1978: a face point is the mean of its corners, an edge point the mean of its ends and its two
    face points, a vertex of valence n moves to ``(F + 2 R + (n - 3) P) / n``. Boundaries follow
    the cubic B-spline of their own vertices. New vertices are ordered: old, edges, faces.

    Args:
        quads: faces; a 4th index of -1 marks a triangle, which becomes three quads.
        vertex_count: number of vertices n (isolated ones stay where they are).

    Raises:
        ValueError: an index is out of range, or an edge has more than two faces.
    """
    quads = _checked(quads, vertex_count)
    face, vertex, following, previous = _corners(quads)
    edges = _edges(vertex, following)
    edge_count, face_count = len(edges.pairs), len(quads)
    size = np.bincount(face, minlength=face_count)
    first_edge, first_face = vertex_count, vertex_count + edge_count

    face_point = sparse.csr_matrix((1.0 / size[face], (face, vertex)), (face_count, vertex_count))
    interior = edges.faces == 2
    share = np.where(interior, 0.25, 0.5)
    ends = sparse.csr_matrix(
        (np.repeat(share, 2), (np.repeat(np.arange(edge_count), 2), edges.pairs.ravel())),
        (edge_count, vertex_count),
    )
    beside = sparse.csr_matrix(
        (np.where(interior, 0.25, 0.0)[edges.of_corner], (edges.of_corner, face)),
        (edge_count, face_count),
    )
    edge_point = ends + beside @ face_point

    on_border, border_entries = _boundary_rule(edges, vertex_count)
    valence = np.bincount(vertex, minlength=vertex_count)
    inner = ~on_border & (valence > 0)
    n = np.maximum(valence, 1)
    weight = np.where(inner, 1.0 / n**2, 0.0)
    around = sparse.csr_matrix((weight[vertex], (vertex, face)), (vertex_count, face_count))
    # Each interior edge leaves a vertex once among its corners, so corners enumerate the star:
    # R is the mean of (P + neighbour) / 2, hence 2 R / n = P / n + sum(neighbour) / n^2.
    neighbours = sparse.csr_matrix((weight[vertex], (vertex, following)), (vertex_count,) * 2)
    stay = sparse.diags(np.where(inner, (n - 2.0) / n, np.where(valence == 0, 1.0, 0.0)))
    border = sparse.csr_matrix((border_entries[2], border_entries[:2]), (vertex_count,) * 2)
    vertex_point = around @ face_point + neighbours + stay + border

    matrix = sparse.csr_matrix(sparse.vstack([vertex_point, edge_point, face_point]))
    matrix.eliminate_zeros()
    refined = np.stack(
        [
            vertex,
            first_edge + edges.of_corner,
            first_face + face,
            first_edge + edges.of_corner[previous],
        ],
        axis=1,
    )
    linear = sparse.csr_matrix(
        sparse.vstack([sparse.identity(vertex_count), _midpoints(edges, vertex_count), face_point])
    )
    return Refinement(matrix, linear, refined, face)


def loop(faces: Int[np.ndarray, "f 3"], vertex_count: int) -> Refinement:
    """One level of Loop subdivision of a triangle mesh with smooth boundary curves.

    Loop, "Smooth subdivision surfaces based on triangles", 1987: an edge point weighs its ends
    3/8 and the two opposite corners 1/8; a vertex of valence n moves by
    ``beta = (5/8 - (3/8 + cos(2 pi / n) / 4)^2) / n`` towards each neighbour. New vertices are
    ordered: old, edges. The refined quads are triangles (4th index -1).

    Raises:
        ValueError: ``faces`` is not (f, 3), an index is out of range, or an edge has more than
            two faces.
    """
    faces = np.asarray(faces)
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError(f"Loop subdivision needs triangles (f, 3), got {faces.shape}")
    quads = _checked(faces, vertex_count)
    face, vertex, following, previous = _corners(quads)
    edges = _edges(vertex, following)
    edge_count = len(edges.pairs)
    shape = (vertex_count + edge_count, vertex_count)

    interior = edges.faces == 2
    opposite = vertex[previous]
    inside = interior[edges.of_corner]
    on_border, border_entries = _boundary_rule(edges, vertex_count)
    valence = np.bincount(vertex, minlength=vertex_count)
    n = np.maximum(valence, 1)
    beta = (0.625 - (0.375 + 0.25 * np.cos(2 * np.pi / n)) ** 2) / n
    beta = np.where(on_border | (valence == 0), 0.0, beta)
    stay = np.where(on_border, 0.0, 1.0 - n * beta)
    star = ~on_border[vertex]
    edge_rows = vertex_count + np.arange(edge_count)
    entries = [
        (
            np.repeat(edge_rows, 2),
            edges.pairs.ravel(),
            np.repeat(np.where(interior, 0.375, 0.5), 2),
        ),
        (vertex_count + edges.of_corner[inside], opposite[inside], np.full(inside.sum(), 0.125)),
        (vertex[star], following[star], beta[vertex[star]]),
        (np.arange(vertex_count), np.arange(vertex_count), stay),
        border_entries,
    ]
    matrix = _matrix(entries, shape)
    matrix.eliminate_zeros()
    middle = vertex_count + edges.of_corner.reshape(-1, 3)
    a, b, c = faces.T
    ab, bc, ca = middle.T
    triangles = np.stack(
        [np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))],
        axis=1,
    ).reshape(-1, 3)
    refined = np.concatenate([triangles, np.full((len(triangles), 1), -1)], axis=1)
    linear = sparse.vstack([sparse.identity(vertex_count), _midpoints(edges, vertex_count)])
    return Refinement(
        matrix, sparse.csr_matrix(linear), refined, np.repeat(np.arange(len(faces)), 4)
    )
