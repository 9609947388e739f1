"""Closest points of a triangle mesh.

On the host: candidates by a tree over the triangles' middles, then exact distances.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from jaxface._types import Float, Int


class ClosestPoints(NamedTuple):
    """The point of a mesh nearest to each query."""

    triangle: Int[np.ndarray, "q"]
    weights: Float[np.ndarray, "q 3"]
    """of the triangle's corners"""
    point: Float[np.ndarray, "q 3"]
    distance: Float[np.ndarray, "q"]


class TriangleTree:
    """A mesh prepared for many queries."""

    def __init__(self, vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"]):
        """Build the tree.

        Raises:
            ValueError: there is no triangle.
        """
        self.faces = np.asarray(faces)
        if not len(self.faces):
            raise ValueError("faces is empty; a mesh with at least one triangle is needed")
        self.vertices = np.asarray(vertices, np.float64)
        self.corners = self.vertices[self.faces]
        self._tree = KDTree(self.corners.mean(axis=1))

    def __call__(self, points: Float[np.ndarray, "q 3"], candidates: int = 12) -> ClosestPoints:
        """The nearest point of the surface to each of ``points``.

        Exact where the nearest triangle is among the ``candidates`` whose middles are nearest,
        which holds for meshes of triangles of similar size.
        """
        points = np.asarray(points, np.float64)
        count = min(candidates, len(self.faces))
        best = np.full(len(points), np.inf)
        triangle, weights = np.zeros(len(points), np.int64), np.zeros((len(points), 3))
        for start in range(0, len(points), 1 << 16):
            part = slice(start, start + (1 << 16))
            _, near = self._tree.query(points[part], count)
            near = near.reshape(-1, count)
            for column in near.T:
                w = closest_weights(points[part], self.corners[column])
                foot = np.einsum("qi,qid->qd", w, self.corners[column])
                distance = np.linalg.norm(foot - points[part], axis=1)
                better = distance < best[part]
                best[part][better] = distance[better]
                triangle[part][better], weights[part][better] = column[better], w[better]
        point = np.einsum("qi,qid->qd", weights, self.corners[triangle])
        return ClosestPoints(triangle, weights, point, best)


def closest_weights(
    points: Float[np.ndarray, "q 3"], corners: Float[np.ndarray, "q 3 3"]
) -> Float[np.ndarray, "q 3"]:
    """Barycentric weights of the point of triangle i nearest to point i.

    The foot on the plane where it lies inside, else the nearest point of the three edges
    (Ericson, "Real-time collision detection", 2005, section 5.1.5).
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    e1, e2, d = b - a, c - a, points - a
    g11, g12, g22 = (np.einsum("qd,qd->q", u, v) for u, v in ((e1, e1), (e1, e2), (e2, e2)))
    r1, r2 = np.einsum("qd,qd->q", e1, d), np.einsum("qd,qd->q", e2, d)
    determinant = g11 * g22 - g12 * g12
    flat = determinant <= 1e-14 * g11 * g22
    inverse = 1.0 / np.where(flat, 1.0, determinant)
    v, w = (g22 * r1 - g12 * r2) * inverse, (g11 * r2 - g12 * r1) * inverse
    inside = (v >= 0) & (w >= 0) & (v + w <= 1) & ~flat
    result = np.stack([1 - v - w, v, w], axis=1)
    best = np.where(inside, -1.0, np.inf)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        edge = corners[:, j] - corners[:, i]
        length2 = np.maximum(np.einsum("qd,qd->q", edge, edge), 1e-300)
        t = np.clip(np.einsum("qd,qd->q", points - corners[:, i], edge) / length2, 0, 1)
        foot = corners[:, i] + t[:, None] * edge
        distance = np.einsum("qd,qd->q", points - foot, points - foot)
        nearer = distance < best
        best = np.where(nearer, distance, best)
        result[nearer] = 0.0
        result[nearer, i], result[nearer, j] = 1 - t[nearer], t[nearer]
    return result
