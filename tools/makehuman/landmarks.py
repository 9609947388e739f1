"""Landmark correspondences found by looking: render, detect, intersect, average, symmetrise."""

from collections.abc import Callable

import numpy as np

# The 68 iBUG points from the 468 of the MediaPipe face mesh; two indices are averaged.
IBUG_FROM_MESH = (
    (127,), (234,), (93,), (132, 58), (58, 172), (136,), (150,), (176,), (152,),
    (400,), (379,), (365,), (397, 288), (361, 288), (323,), (454,), (356,),
    (70,), (63,), (105,), (66,), (107,), (336,), (296,), (334,), (293,), (300,),
    (168,), (6, 197), (195, 5), (4,), (98,), (97,), (2,), (326,), (327,),
    (33,), (160,), (158,), (133,), (153,), (144,),
    (362,), (385,), (387,), (263,), (373,), (380,),
    (61,), (39,), (37,), (0,), (267,), (269,), (291,), (405,), (314,), (17,), (84,), (181,),
    (78,), (82,), (13,), (312,), (308,), (317,), (14,), (87,),
)
# Pairs of the mesh's mirror map are found from the canonical face; these detect it without it.
BROWS = ((70, 63, 105, 66, 107, 55, 65, 52, 53, 46), (300, 293, 334, 296, 336, 285, 295, 282, 283, 276))

Detector = Callable[[np.ndarray], np.ndarray]
"""uint8 sRGB image (H, W, 3) -> 468 pixel positions (468, 2)"""


def nearest_on_surface(
    points: np.ndarray, vertices: np.ndarray, triangles: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Closest point of a mesh to each point: triangle ids (k,), barycentrics (k, 3), distance."""
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    ids, weights, distances = [], [], []
    for p in points:
        w = _closest_barycentric(p, a, b, c)
        d = np.linalg.norm(np.einsum("ti,itc->tc", w, np.stack([a, b, c])) - p, axis=1)
        best = d.argmin()
        ids.append(best)
        weights.append(w[best])
        distances.append(d[best])
    return np.array(ids), np.array(weights), np.array(distances)


def _closest_barycentric(p: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Barycentrics (t, 3) of the closest point to ``p`` of each triangle."""
    ab, ac, ap = b - a, c - a, p - a
    d00, d01, d11 = (ab * ab).sum(1), (ab * ac).sum(1), (ac * ac).sum(1)
    d20, d21 = (ap * ab).sum(1), (ap * ac).sum(1)
    determinant = np.maximum(d00 * d11 - d01**2, 1e-12)
    v = (d11 * d20 - d01 * d21) / determinant
    w = (d00 * d21 - d01 * d20) / determinant
    inside = np.stack([1 - v - w, v, w], axis=1)
    candidates = [np.where((inside >= 0).all(1)[:, None], inside, np.nan)]
    for i, (start, end) in enumerate(((a, b), (b, c), (c, a))):
        edge = end - start
        t = ((p - start) * edge).sum(1) / np.maximum((edge * edge).sum(1), 1e-12)
        t = t.clip(0, 1)
        weight = np.zeros((len(a), 3))
        weight[:, i], weight[:, (i + 1) % 3] = 1 - t, t
        candidates.append(weight)
    stacked = np.stack(candidates)  # (4, t, 3)
    position = np.einsum("kti,itc->ktc", stacked, np.stack([a, b, c]))
    distance = np.linalg.norm(position - p, axis=2)
    best = np.nanargmin(distance, axis=0)
    return stacked[best, np.arange(len(a))]


def derive_68(
    mesh468: np.ndarray, vertices: np.ndarray, triangles: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Triangle ids (68,) and barycentrics (68, 3) of the iBUG points from 468 positions."""
    points = np.stack([mesh468[list(members)].mean(0) for members in IBUG_FROM_MESH])
    ids, weights, _ = nearest_on_surface(points, vertices, triangles)
    return ids, weights
