"""What a face scan lacks and a photo shows: paint for a model without albedo, eyeballs, a mouth.

Props are rendered but are not part of the truth: no vertex of the model moves and no albedo of
the model is replaced. They only fill the holes that a shape-only model leaves at eyes and mouth.
"""

import numpy as np
from mitsuba_scene import Surface
from scipy.optimize import least_squares
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

EYEBALL_RADIUS = 12.0  # mm, adult mean of the axial radius
RIGHT_EYE, LEFT_EYE, OUTER_LIPS = slice(36, 42), slice(42, 48), slice(48, 60)
BROWS = (slice(17, 22), slice(22, 27))


def boundary_loops(faces: np.ndarray, count: int) -> list[np.ndarray]:
    """Vertex indices of each connected set of boundary edges of a triangle mesh, unordered."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    unique, uses = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)
    border = unique[uses == 1]
    if len(border) == 0:
        return []
    graph = coo_matrix((np.ones(len(border)), border.T), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    members = np.unique(border)
    return [members[label[members] == value] for value in np.unique(label[members])]


def _segment_distance(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Distance (n,) from points (n, 3) to a polyline (k, 3)."""
    best = np.full(len(points), np.inf)
    for start, end in zip(line[:-1], line[1:], strict=True):
        along = end - start
        t = np.clip((points - start) @ along / (along @ along), 0.0, 1.0)
        best = np.minimum(best, np.linalg.norm(points - start - t[:, None] * along, axis=1))
    return best


def _inside_polygon(points: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """Even-odd test of points (n, 2) against a closed polygon (k, 2)."""
    following = np.roll(polygon, -1, axis=0)
    inside = np.zeros(len(points), bool)
    for (x0, y0), (x1, y1) in zip(polygon, following, strict=True):
        crosses = (y0 > points[:, 1]) != (y1 > points[:, 1])
        height = y1 - y0 if y1 != y0 else 1.0
        inside ^= crosses & (points[:, 0] < (x1 - x0) * (points[:, 1] - y0) / height + x0)
    return inside


def painted_albedo(mean: np.ndarray, landmarks: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A face's albedo (n, 3), linear RGB, painted on the mean shape around its 68 landmarks.

    Skin of a random tone with redder cheeks and nose, dark brows and lid margins, lips. Lands in
    no albedo basis, so a fit can only approximate it, as with a photo.
    """
    depth = rng.uniform(0.0, 1.0)
    light, dark = np.array([0.58, 0.38, 0.29]), np.array([0.20, 0.115, 0.08])
    skin = light ** (1 - depth) * dark**depth * (1 + rng.uniform(-0.05, 0.05, 3))
    albedo = np.tile(skin, (len(mean), 1))
    flush = np.zeros(len(mean))
    cheeks = [(landmarks[31] + landmarks[2]) / 2, (landmarks[35] + landmarks[14]) / 2]
    for centre, width in [(cheeks[0], 18.0), (cheeks[1], 18.0), (landmarks[30], 12.0)]:
        flush += np.exp(-0.5 * np.sum((mean - centre) ** 2, axis=1) / width**2)
    albedo *= 1 - np.minimum(flush, 1.0)[:, None] * np.array([0.02, 0.16, 0.14])

    lips = landmarks[OUTER_LIPS]
    near = mean[:, 2] > lips[:, 2].min() - 12.0
    inside = _inside_polygon(mean[:, :2], lips[:, :2]) & near
    border = _segment_distance(mean, np.concatenate([lips, lips[:1]]))
    blend = np.where(inside, 1.0, np.exp(-0.5 * (border / 1.2) ** 2) * near)[:, None]
    albedo = albedo * (1 - blend) + blend * skin * np.array([0.85, 0.50, 0.52])

    hair = np.array([0.05, 0.032, 0.024]) * rng.uniform(0.6, 2.0)
    for brow in BROWS:
        distance = _segment_distance(mean, landmarks[brow])
        cover = (0.85 * np.exp(-0.5 * (distance / 3.2) ** 2))[:, None]
        albedo = albedo * (1 - cover) + cover * hair
    for eye in (RIGHT_EYE, LEFT_EYE):
        ring = np.concatenate([landmarks[eye], landmarks[eye][:1]])
        cover = (0.6 * np.exp(-0.5 * (_segment_distance(mean, ring) / 1.3) ** 2))[:, None]
        albedo = albedo * (1 - cover) + cover * hair
    return np.clip(albedo, 0.005, 0.95).astype(np.float32)


def _eyeball(rim: np.ndarray, outward: np.ndarray, gaze: np.ndarray, iris: np.ndarray) -> Surface:
    """A sphere that rests behind the lid margin ``rim`` (k, 3), its iris facing ``gaze``."""
    start = rim.mean(axis=0) - outward * (EYEBALL_RADIUS - 3.0)

    def gap(offset: np.ndarray) -> np.ndarray:
        reach = np.linalg.norm(rim - start - offset, axis=1) - EYEBALL_RADIUS
        return np.concatenate([reach, 0.2 * offset])

    centre = start + least_squares(gap, np.zeros(3)).x
    polar = np.linspace(0.0, np.pi, 96)
    around = np.linspace(0.0, 2 * np.pi, 97)[:-1]
    side = np.cross(gaze, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    frame = np.stack([side, np.cross(side, gaze), gaze])
    p, a = np.meshgrid(polar, around, indexing="ij")
    unit = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=-1)
    colour = np.tile(np.array([0.62, 0.58, 0.55]), (p.size, 1))
    ring = p.ravel()
    colour[ring < np.arcsin(5.9 / EYEBALL_RADIUS)] = iris
    colour[(ring > 0.46) & (ring < np.arcsin(5.9 / EYEBALL_RADIUS))] *= 0.5
    colour[ring < np.arcsin(1.9 / EYEBALL_RADIUS)] = 0.006
    index = np.arange(p.size).reshape(p.shape)
    nw, ne = index[:-1], np.roll(index[:-1], -1, axis=1)
    sw, se = index[1:], np.roll(index[1:], -1, axis=1)
    faces = np.concatenate(
        [np.stack([nw, ne, sw], -1).reshape(-1, 3), np.stack([ne, se, sw], -1).reshape(-1, 3)]
    )
    return Surface(centre + EYEBALL_RADIUS * unit.reshape(-1, 3) @ frame, faces, colour, 0.05)


def _mouth(rim: np.ndarray, outward: np.ndarray) -> Surface:
    """A dark funnel behind the inner lips (k, 3)."""
    centre = rim.mean(axis=0)
    u, _, vt = np.linalg.svd(rim - centre, full_matrices=False)
    order = np.argsort(np.arctan2(u[:, 1], u[:, 0]))
    vertices = np.concatenate([rim[order], [centre - 18.0 * outward]])
    following = np.roll(np.arange(len(rim)), -1)
    faces = np.stack([np.arange(len(rim)), following, np.full(len(rim), len(rim))], axis=1)
    return Surface(vertices, faces, np.tile([0.05, 0.012, 0.012], (len(vertices), 1)))


def fill_holes(
    mean: np.ndarray,
    vertices: np.ndarray,
    faces: np.ndarray,
    landmarks: np.ndarray,
    outward: np.ndarray,
    iris: np.ndarray,
) -> list[Surface]:
    """Props for the holes of a head, in the frame of ``vertices``.

    ``mean`` and ``landmarks`` (68, 3) are in the model's frame and tell which hole is which (a hole
    within 12 mm of an eye's landmarks is a socket, of the mouth's a mouth; others stay open).
    ``outward`` is the direction out of the face in the frame of ``vertices``, ``iris`` linear RGB.
    """
    gaze = -vertices.mean(axis=0) / np.linalg.norm(vertices.mean(axis=0))
    gaze = 0.5 * gaze + 0.5 * outward  # between the camera and straight ahead
    gaze = gaze / np.linalg.norm(gaze)
    props = []
    for loop in boundary_loops(faces, len(mean)):
        centre = mean[loop].mean(axis=0)
        for part in (RIGHT_EYE, LEFT_EYE, OUTER_LIPS):
            if np.linalg.norm(centre - landmarks[part].mean(axis=0)) > 12.0:
                continue
            rim = vertices[loop]
            props.append(
                _mouth(rim, outward) if part is OUTER_LIPS else _eyeball(rim, outward, gaze, iris)
            )
    return props
