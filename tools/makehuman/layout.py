"""UV layout of the head: the face island enlarged, the small islands packed above it.

hm08's head unwraps sideways in the body's square. It is turned upright; the face keeps its
proportions (one scale for u and v), while the sides and the back of the head, which carry
hair, are compressed in u so that the face covers about a third of the square.
"""

import numpy as np

from makehuman.topology import HeadMesh

MARGIN = 0.006
FACE_HALF_WIDTH = 0.125  # in the body's UV units: up to just before the ears
MIDLINE = 0.4831
MAIN_TOP = 0.80  # height of the main island in the new square


def relayout(head: HeadMesh) -> np.ndarray:
    """UV coordinates (m, 2) in [0, 1]^2, origin bottom-left, no two islands overlapping."""
    island = islands(head.uv_quads, len(head.source_uv))
    upright = np.stack([head.source_uv[:, 1], 1 - head.source_uv[:, 0]], axis=1)
    uv = np.zeros_like(upright)
    sizes = np.bincount(island)
    main = sizes.argmax()
    inside = island == main
    uv[inside] = _main_island(upright[inside])

    # Slots (u0, v0, u1, v1) of the strip above; the strip's own middle is free down to the
    # notch between the two lobes of the back of the head.
    slots = {
        "neck": (0.0, MAIN_TOP, 0.40, 1.0),
        "mouth_cavity": (0.40, MAIN_TOP, 0.62, 1.0),
        "helper-tongue": (0.62, MAIN_TOP, 0.68, 1.0),
        "helper-upper-teeth": (0.68, MAIN_TOP + 0.10, 0.84, 1.0),
        "helper-lower-teeth": (0.68, MAIN_TOP, 0.84, MAIN_TOP + 0.10),
        "eye_l": (0.84, 0.92, 0.92, 1.0),
        "eye_r": (0.92, 0.92, 1.0, 1.0),
        "eye_cavity_l": (0.84, MAIN_TOP, 0.92, 0.92),
        "eye_cavity_r": (0.92, MAIN_TOP, 1.0, 0.92),
    }
    for name, slot in slots.items():
        ids = np.unique(island[(head.uv_part == name) & ~inside])
        members = np.isin(island, ids)
        turned = upright if not name.startswith("eye_l") and name != "eye_r" else head.source_uv
        uv[members] = _fit(turned[members], slot)
    return uv


def islands(uv_quads: np.ndarray, count: int) -> np.ndarray:
    """Connected component (count,) of each UV corner."""
    from scipy import sparse

    pairs = np.concatenate([uv_quads[:, [k, (k + 1) % 4]] for k in range(4)])
    pairs = pairs[(pairs >= 0).all(1)]
    graph = sparse.coo_matrix((np.ones(len(pairs)), pairs.T), (count, count))
    return sparse.csgraph.connected_components(graph, directed=False)[1]


def _main_island(points: np.ndarray) -> np.ndarray:
    low, high = points[:, 1].min(), points[:, 1].max()
    scale = (MAIN_TOP - 2 * MARGIN) / (high - low)
    offset = points[:, 0] - MIDLINE
    reach = np.abs(offset).max()
    # Beyond the face |u| follows a quadratic whose slope starts at ``scale`` and whose end
    # meets the margin: C1 and monotone.
    room = 0.5 - MARGIN - scale * FACE_HALF_WIDTH
    beyond = np.clip(np.abs(offset) - FACE_HALF_WIDTH, 0, None)
    span = reach - FACE_HALF_WIDTH
    ratio = room / (scale * span)
    t = beyond / span
    # Rational ease t -> t / (1 + c t): slope 1 at 0, value 1/(1+c) = ratio at 1.
    squeezed = scale * span * t / (1 + (1 / ratio - 1) * t)
    u = np.sign(offset) * (scale * np.minimum(np.abs(offset), FACE_HALF_WIDTH) + squeezed)
    return np.stack([0.5 + u, MARGIN + (points[:, 1] - low) * scale], axis=1)


def _fit(points: np.ndarray, slot: tuple[float, float, float, float]) -> np.ndarray:
    """Isotropic fit of ``points`` into the middle of a slot, a margin kept."""
    low, high = points.min(0), points.max(0)
    corner, size = np.array(slot[:2]) + MARGIN, np.array(slot[2:]) - np.array(slot[:2]) - 2 * MARGIN
    scale = (size / (high - low)).min()
    return corner + size / 2 + (points - (low + high) / 2) * scale
