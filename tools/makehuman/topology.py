"""Which part of the body mesh is the head, its new eyeballs, and its new vertex numbering.

Every vertex of the new mesh is a fixed linear combination of the base mesh's vertices, so
that morph targets carry over exactly.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from makehuman.source import BaseMesh

NECK_RINGS = 4
CAVITY_RINGS = 3
# Polar angles (degrees) of the eyeball's rings. MakeHuman's eyeballs are a third too big, so that
# a pupil of 2 mm and a limbus of 6 mm radius lie at 7 and 20 degrees.
EYE_RINGS = (3.5, 6.0, 8.0, 13.0, 18.0, 21.5, 30.0, 44.0, 63.0, 86.0)
PUPIL_ANGLE, LIMBUS_ANGLE = 7.0, 20.0
EYE_SEGMENTS = 12
INTERIOR = ("mouth_cavity", "helper-upper-teeth", "helper-lower-teeth", "helper-tongue")


@dataclass(frozen=True)
class HeadMesh:
    """The cut-out head in its own numbering; ``part`` and ``eye_angle`` are per vertex."""

    from_base: sparse.csr_matrix  # (n, base vertices)
    quads: np.ndarray  # (q, 4), 4th = -1 for a triangle
    source_uv: np.ndarray  # (m, 2) in the body's layout; for eyes in polar layout
    uv_quads: np.ndarray  # (q, 4)
    part: np.ndarray  # (n,) str
    uv_part: np.ndarray  # (m,) str
    eye_angle: np.ndarray  # (n,) polar angle in degrees on eyeballs, NaN elsewhere


def grow(quads: np.ndarray, seed: np.ndarray, allowed: np.ndarray, rings: int) -> np.ndarray:
    """Mask of ``allowed`` quads within ``rings`` quad rings of ``seed``, reached over edges."""
    reached = np.zeros(len(quads), bool)
    touched = np.zeros(quads.max() + 1, bool)
    touched[quads[seed]] = True
    for _ in range(rings):
        reached |= allowed & (touched[quads].sum(1) >= 2)
        touched[quads[reached]] = True
    return reached


def eyeball(base: BaseMesh, group: str) -> tuple[sparse.csr_matrix, np.ndarray, np.ndarray]:
    """Weights (k, base vertices) of a polar-ring eyeball, its quads and polar angles (degrees).

    Each ray from the helper eye's centre is cast against the helper's quads; the hit's bilinear
    weights, stretched radially to the sphere, make the new vertex linear in the helper.
    """
    faces = base.quads[base.group == group]
    members = np.unique(faces)
    points = base.vertices[members]
    centre = (points.max(0) + points.min(0)) / 2
    radius = np.linalg.norm(points - centre, axis=1).max()
    theta = np.radians(np.concatenate([[0.0], np.repeat(EYE_RINGS, EYE_SEGMENTS)]))
    phi = np.tile(np.arange(EYE_SEGMENTS), len(EYE_RINGS)) * 2 * np.pi / EYE_SEGMENTS
    phi = np.concatenate([[0.0], phi])
    rays = np.stack(
        [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1
    )
    triangles = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
    corner = base.vertices[triangles] - centre  # (t, 3, 3)
    inverse = np.linalg.inv(np.swapaxes(corner, 1, 2))
    hit = np.einsum("tij,kj->kti", inverse, rays)  # barycentrics times 1/distance
    best = np.argmax(hit.min(2), axis=1)
    weights = hit[np.arange(len(rays)), best]
    weights = weights / weights.sum(1, keepdims=True)
    rows = np.repeat(np.arange(len(rays)), 3)
    shape = (len(rays), len(base.vertices))
    chord = sparse.csr_matrix((weights.ravel(), (rows, triangles[best].ravel())), shape)
    stretch = radius / np.linalg.norm(chord @ base.vertices - centre, axis=1)
    mean_row = np.full(len(members), 1 / len(members))
    mean = sparse.csr_matrix(
        (
            np.tile(mean_row, len(rays)),
            (np.repeat(np.arange(len(rays)), len(members)), np.tile(members, len(rays))),
        ),
        shape,
    )
    linear = sparse.csr_matrix(sparse.diags(stretch) @ chord + sparse.diags(1 - stretch) @ mean)

    ring = 1 + np.arange(len(EYE_RINGS) * EYE_SEGMENTS).reshape(len(EYE_RINGS), EYE_SEGMENTS)
    following = np.roll(ring, -1, axis=1)
    pole = np.stack(
        [np.zeros(EYE_SEGMENTS, int), ring[0], following[0], np.full(EYE_SEGMENTS, -1)], axis=1
    )
    bands = np.stack([ring[:-1], ring[1:], following[1:], following[:-1]], axis=-1)
    return linear, np.concatenate([pole, bands.reshape(-1, 4)]), np.degrees(theta)


def cut_head(base: BaseMesh) -> HeadMesh:
    """Head, a capped piece of neck, lids' inner rings, mouth, teeth, tongue and new eyeballs."""
    group = base.group.copy()
    head = group == "head"
    neck = grow(base.quads, head, group == "body", NECK_RINGS)
    group[neck] = "neck"
    for side in "lr":
        cavity = f"eye_cavity_{side}"
        near = grow(base.quads, head, group == cavity, CAVITY_RINGS)
        group[(group == cavity) & ~near] = "body"
        group[near] = cavity
    kept = np.isin(group, ["head", "neck", "eye_cavity_l", "eye_cavity_r", *INTERIOR])
    members, quads = np.unique(base.quads[kept], return_inverse=True)
    uv_members, uv_quads = np.unique(base.uv_quads[kept], return_inverse=True)
    quads, uv_quads = quads.reshape(-1, 4), uv_quads.reshape(-1, 4)
    part = np.full(len(members), "head", "U32")
    uv_part = np.full(len(uv_members), "head", "U32")
    kept_group = group[kept]
    for name in ("neck", "eye_cavity_l", "eye_cavity_r", *INTERIOR, "head"):
        part[quads[kept_group == name]] = name
        uv_part[uv_quads[kept_group == name]] = name

    rows = [
        sparse.csr_matrix(
            (np.ones(len(members)), (np.arange(len(members)), members)),
            (len(members), len(base.vertices)),
        )
    ]
    angles = [np.full(len(members), np.nan)]
    parts, uv_parts, all_quads, all_uv_quads = [part], [uv_part], [quads], [uv_quads]
    uvs = [base.uv[uv_members]]
    count, uv_count = len(members), len(uv_members)
    for side in "lr":
        linear, eye_quads, angle = eyeball(base, f"helper-{side}-eye")
        rows.append(linear)
        angles.append(angle)
        parts.append(np.full(len(angle), f"eye_{side}", "U32"))
        uv_parts.append(parts[-1])
        turn = np.concatenate([[0], np.tile(np.arange(EYE_SEGMENTS), len(EYE_RINGS))])
        phi = turn * 2 * np.pi / EYE_SEGMENTS
        uvs.append(np.stack([angle * np.cos(phi), angle * np.sin(phi)], axis=1) / 86.0)
        all_quads.append(np.where(eye_quads < 0, -1, eye_quads + count))
        all_uv_quads.append(np.where(eye_quads < 0, -1, eye_quads + uv_count))
        count, uv_count = count + len(angle), uv_count + len(angle)
    loop = boundary_loop(quads, np.isin(part, ["neck"]))
    size = len(loop)
    rows.append(
        sparse.csr_matrix(
            (np.full(size, 1 / size), (np.zeros(size, int), members[loop])), (1, len(base.vertices))
        )
    )
    angles.append(np.full(1, np.nan))
    parts.append(np.array(["neck_cap"], "U32"))
    turn = np.arange(size) * 2 * np.pi / size
    uvs.append(np.concatenate([[[0.0, 0.0]], np.stack([np.sin(turn), np.cos(turn)], axis=1)]))
    uv_parts.append(np.full(size + 1, "neck_cap", "U32"))
    steps = np.arange(size)
    fan = np.stack([np.roll(steps, -1), steps, np.full(size, -1)], axis=1)
    all_quads.append(
        np.column_stack([np.full(size, count), loop[fan[:, 0]], loop[fan[:, 1]], fan[:, 2]])
    )
    all_uv_quads.append(
        np.column_stack([np.full(size, uv_count), uv_count + 1 + fan[:, :2], fan[:, 2]])
    )
    return HeadMesh(
        sparse.vstack(rows).tocsr(),
        np.concatenate(all_quads),
        np.concatenate(uvs),
        np.concatenate(all_uv_quads),
        np.concatenate(parts),
        np.concatenate(uv_parts),
        np.concatenate(angles),
    )


def boundary_loop(quads: np.ndarray, among: np.ndarray) -> np.ndarray:
    """The one boundary loop whose vertices are all in the mask ``among``, along its faces' sense.

    Raises:
        ValueError: those boundary edges form no single closed loop.
    """
    edges = np.concatenate([quads[:, [k, (k + 1) % 4]] for k in range(4)])
    directed = {(a, b) for a, b in edges.tolist()}
    border = {a: b for a, b in directed if (b, a) not in directed and among[a] and among[b]}
    loop = [next(iter(sorted(border)))]
    while border.get(loop[-1], loop[0]) != loop[0]:
        loop.append(border[loop[-1]])
    if len(loop) != len(border):
        raise ValueError(f"{len(border)} boundary edges, but a loop of {len(loop)}")
    return np.array(loop)


def triangulate(quads: np.ndarray) -> np.ndarray:
    """Two triangles per quad (split 0-2), one where the 4th index is -1; order of the quads."""
    second = quads[:, [0, 2, 3]]
    both = np.stack([quads[:, :3], second], axis=1).reshape(-1, 3)
    return both[both[:, 2] >= 0]
