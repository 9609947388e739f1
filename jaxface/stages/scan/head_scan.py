"""A scan of a head: a textured triangle mesh, in units and a place of its own."""

from dataclasses import dataclass

import numpy as np

from jaxface._types import Float, Int
from jaxface.models.morphable import MorphableModel
from jaxface.models.skin.regions import skin_fields


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


def mean_head(model: MorphableModel) -> HeadScan:
    """A model's mean face as if it were scanned (mm): its skin, without eyes and mouth.

    Raises:
        ValueError: the model has no 68 landmarks.
    """
    faces = np.asarray(model.faces)
    skin = (np.asarray(skin_fields(model).regions.skin) > 0)[faces].all(axis=1)
    return HeadScan(
        np.asarray(model.mean, np.float64),
        faces[skin],
        np.asarray(model.uv, np.float64),
        np.asarray(model.uv_faces)[skin],
    )
