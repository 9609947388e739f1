"""A scan of a head: a textured triangle mesh, in units and a place of its own."""

from dataclasses import dataclass

import numpy as np

from jaxface._types import Float, Int


@dataclass(frozen=True)
class HeadScan:
    """The surface of a scan, upright, looking along +z; its units do not matter."""

    vertices: Float[np.ndarray, "m 3"]
    faces: Int[np.ndarray, "g 3"]
    """counter-clockwise from outside"""
    uv: Float[np.ndarray, "t 2"]
    """texture coordinates of its maps (origin bottom-left)"""
    uv_faces: Int[np.ndarray, "g 3"]
    """the triangles' corners in ``uv``"""
