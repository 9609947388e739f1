"""UV layout of the head: the face enlarged, the rest compressed, small islands packed above.

hm08's head unwraps sideways in the body's square. It is turned upright; the face keeps its
proportions (one scale for u and v), while the sides, the back and the top of the head, which
carry hair, are compressed away from the face so that the face gets most of the square.
"""

import numpy as np
from scipy import sparse

from makehuman.topology import HeadMesh

MARGIN = 0.006
MIDLINE = 0.48315  # v of the body's UV that is the head's plane of symmetry
FACE_HALF_WIDTH = 0.125  # in the body's UV: to just before the ears
FACE_HEIGHT = 0.225  # in the body's UV: from under the chin to the hairline
MAIN_TOP = 0.855
TRANSITION = 0.25  # share of the compressed stretch over which the scale falls off
SCALE = 2.7  # new UV per body UV inside the face
# Slots (u0, v0, u1, v1) of the strip above.
SLOTS = {
    "neck": (0.0, MAIN_TOP, 0.345, 1.0),
    "mouth_cavity": (0.345, MAIN_TOP, 0.535, 1.0),
    "helper-upper-teeth": (0.535, 0.93, 0.69, 1.0),
    "helper-lower-teeth": (0.535, MAIN_TOP, 0.69, 0.93),
    "helper-tongue": (0.69, MAIN_TOP, 0.725, 1.0),
    "eye_l": (0.725, MAIN_TOP, 0.865, 1.0),
    "eye_r": (0.865, MAIN_TOP, 1.0, 1.0),
    "eye_cavity_r": (0.42, 0.775, 0.50, MAIN_TOP),
    "eye_cavity_l": (0.50, 0.775, 0.58, MAIN_TOP),
    "neck_cap": (0.17, 0.0, 0.24, 0.07),
}


def relayout(head: HeadMesh) -> np.ndarray:
    """UV coordinates (m, 2) in [0, 1]^2, origin bottom-left, no two islands overlapping."""
    island = islands(head.uv_quads, len(head.source_uv))
    upright = np.stack([head.source_uv[:, 1], 1 - head.source_uv[:, 0]], axis=1)
    main = island == np.bincount(island).argmax()
    uv = np.zeros_like(upright)
    uv[main] = _main_island(upright[main])
    for name, slot in SLOTS.items():
        members = np.isin(island, np.unique(island[(head.uv_part == name) & ~main]))
        lying = name not in ("mouth_cavity", "eye_cavity_l", "eye_cavity_r")
        uv[members] = _fit((head.source_uv if lying else upright)[members], slot)
    return uv


def islands(uv_quads: np.ndarray, count: int) -> np.ndarray:
    """Connected component (count,) of each UV corner."""
    pairs = np.concatenate([uv_quads[:, [k, (k + 1) % 4]] for k in range(4)])
    pairs = pairs[(pairs >= 0).all(1)]
    graph = sparse.coo_matrix((np.ones(len(pairs)), pairs.T), (count, count))
    return sparse.csgraph.connected_components(graph, directed=False)[1]


def _main_island(points: np.ndarray) -> np.ndarray:
    offset = points[:, 0] - MIDLINE
    height = points[:, 1] - points[:, 1].min()
    u = np.sign(offset) * _compress(np.abs(offset), FACE_HALF_WIDTH, 0.5 - MARGIN)
    v = _compress(height, FACE_HEIGHT, MAIN_TOP - 2 * MARGIN)
    return np.stack([0.5 + u, MARGIN + v], axis=1)


def _compress(x: np.ndarray, kept: float, room: float) -> np.ndarray:
    """Monotone map of [0, max x] to [0, room]: slope SCALE up to ``kept``, then falling smoothly.

    Beyond ``kept`` the slope follows a smoothstep over TRANSITION of the stretch, down to the
    constant that makes the end meet ``room``.
    """
    span = x.max() - kept
    ratio = (room - SCALE * kept) / (SCALE * span)
    floor = (ratio - TRANSITION / 2) / (1 - TRANSITION / 2)
    if not 0 < floor <= 1:
        raise ValueError(f"no room for the compressed part: end slope {floor:.3f}")
    t = np.clip((x - kept) / span, 0, 1)
    s = np.minimum(t / TRANSITION, 1)
    # Integral of 1 - smoothstep: s - s^3 + s^4 / 2, which is 1/2 at s = 1.
    eased = floor * t + (1 - floor) * TRANSITION * (s - s**3 + s**4 / 2)
    return SCALE * (np.minimum(x, kept) + span * eased)


def _fit(points: np.ndarray, slot: tuple[float, float, float, float]) -> np.ndarray:
    """Isotropic fit of ``points`` into the middle of a slot, a margin kept."""
    low, high = points.min(0), points.max(0)
    corner, size = np.array(slot[:2]) + MARGIN, np.array(slot[2:]) - np.array(slot[:2]) - 2 * MARGIN
    scale = (size / (high - low)).min()
    return corner + size / 2 + (points - (low + high) / 2) * scale
