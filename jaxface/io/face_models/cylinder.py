"""Texture coordinates for a head that has none: a cylinder round the vertical axis."""

import numpy as np

from jaxface._types import Float, Int


def cylindrical_uv(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "m 2"], Int[np.ndarray, "f 3"]]:
    """Project a head (mm, +y up, +z forward) onto an upright cylinder, seam at the back.

    ``u`` grows from the head's right to its left (the image's left to right) with the front at
    the middle; ``v`` grows upward; both fill [0, 1] (origin bottom-left). A triangle that crosses
    the seam gets corners of its own past the edge it mostly lies at, and the whole layout is then
    scaled back into [0, 1], so no triangle spans the map. Triangles that fold over on the
    cylinder (nostrils, ears, the inside of the lips) still share texels; a layout without that
    needs the model's own UVs.

    Returns:
        The coordinates and each triangle's corners in them.
    """
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    behind = np.linalg.norm(normals[normals[:, 2] < 0], axis=1).sum()
    closed = behind > 0.3 * np.linalg.norm(normals, axis=1).sum()
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    # The axis of a closed head is its middle; that of an open face its back rim, so that the face
    # spans half a turn.
    axis_z = 0.5 * (low[2] + high[2]) if closed else low[2]
    angle = np.arctan2(vertices[:, 0] - 0.5 * (low[0] + high[0]), vertices[:, 2] - axis_z)
    v = (vertices[:, 1] - low[1]) / max(float(high[1] - low[1]), 1e-9)

    u = 0.5 + angle[faces] / (2 * np.pi)
    crossing = np.ptp(u, axis=1) > 0.5
    u = np.where(crossing[:, None] & (u < 0.5), u + 1.0, u)
    u = np.where(crossing[:, None] & (u.mean(axis=1, keepdims=True) > 1.0), u - 1.0, u)
    # One coordinate for each vertex and turn it appears with.
    turn = np.rint(u - (0.5 + angle[faces] / (2 * np.pi))).astype(np.int64)
    keys, index = np.unique(faces.astype(np.int64) * 3 + turn + 1, return_inverse=True)
    owner = keys // 3
    across = 0.5 + angle[owner] / (2 * np.pi) + keys % 3 - 1
    # The same reach on both sides keeps the front in the middle.
    reach = max(float(np.abs(across - 0.5).max()), 1e-9)
    uv = np.stack([0.5 + 0.5 * (across - 0.5) / reach, v[owner]], axis=1)
    return np.clip(uv, 0.0, 1.0), index.reshape(faces.shape).astype(np.int32)
