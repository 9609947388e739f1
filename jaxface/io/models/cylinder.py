"""Texture coordinates for a head that has none: a cylinder round the vertical axis."""

import numpy as np

from jaxface._types import Float, Int


def cylindrical_uv(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "m 2"], Int[np.ndarray, "f 3"]]:
    """Project a head (mm, +y up, +z forward) onto an upright cylinder, seam at the back.

    ``u`` grows from the head's right to its left (the image's left to right) with the front at
    the middle; ``v`` grows upward; both fill [0, 1] (origin bottom-left). The corners of a
    triangle that crosses the seam are split: the low-``u`` ones continue past the right edge,
    and the whole layout is then scaled back into [0, 1], so no triangle spans the map. Triangles
    that fold over on the cylinder (nostrils, ears, the inside of the lips) still share texels;
    a layout without that needs the model's own UVs.

    Returns:
        The coordinates and each triangle's corners in them.
    """
    centre_x = 0.5 * (vertices[:, 0].min() + vertices[:, 0].max())
    # The axis of an open face goes through its back rim, so that the face spans half a turn.
    depth = vertices[:, 2].max() - vertices[:, 2].min()
    width = vertices[:, 0].max() - vertices[:, 0].min()
    axis_z = vertices[:, 2].max() - min(depth, 0.6 * max(width, 1e-6))
    angle = np.arctan2(vertices[:, 0] - centre_x, vertices[:, 2] - axis_z)
    turn = 0.5 + angle / (2 * np.pi)
    height = vertices[:, 1] - vertices[:, 1].min()
    v = height / max(float(height.max()), 1e-9)

    corners = turn[faces]
    crossing = corners.max(axis=1) - corners.min(axis=1) > 0.5
    wrapped = crossing[:, None] & (corners < 0.5)
    moved, where = np.unique(faces[wrapped], return_inverse=True)
    uv_faces = faces.copy()
    uv_faces[wrapped] = len(vertices) + where
    u = np.concatenate([turn, turn[moved] + 1.0])
    # A vertex all of whose triangles wrapped keeps no corner of its own; it must not stretch the
    # range, and neither must vertices outside every triangle.
    used = np.unique(uv_faces)
    low, high = u[used].min(), u[used].max()
    uv = np.stack([(u - low) / max(high - low, 1e-9), np.concatenate([v, v[moved]])], axis=1)
    return np.clip(uv, 0.0, 1.0), uv_faces
