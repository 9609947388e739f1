"""Which texels of a UV layout are face, other skin, or neither."""

from typing import NamedTuple

import numpy as np

from jaxface._types import Bool, Int
from jaxface.geometry.uv import UVLayout
from jaxface.models.morphable import MorphableModel
from jaxface.models.regions import FACE_REGIONS, NOT_SKIN


class Charts(NamedTuple):
    """Texels by what they show; row 0 at the top.

    Attributes:
        face: skin of the face in one piece.
        skin: all skin: not the eyes, not the inside of the mouth.
        inside: the charts of the layout.
        vertex: a vertex of each texel's triangle.
    """

    face: Bool[np.ndarray, "r r"]
    skin: Bool[np.ndarray, "r r"]
    inside: Bool[np.ndarray, "r r"]
    vertex: Int[np.ndarray, "r r"]


def charts(model: MorphableModel, layout: UVLayout) -> Charts:
    """The charts of a model's layout, by its regions; without regions all of it is face.

    Args:
        model: with the layout's topology.
        layout: of the model.
    """
    triangle = np.maximum(np.asarray(layout.triangle), 0)
    faces, inside = np.asarray(model.faces), np.asarray(layout.inside)

    def within(*names: str) -> np.ndarray:
        known = [name for name in names if name in model.region_names]
        if not known:
            return np.zeros(inside.shape, bool)
        covered = np.all(np.asarray(model.region_mask(*known))[faces], axis=1)
        return np.asarray(covered)[triangle] & inside

    face = within(*FACE_REGIONS) if model.region_names else inside
    return Charts(largest_part(face), inside & ~within(*NOT_SKIN), inside, faces[triangle, 0])


def largest_part(mask: Bool[np.ndarray, "r r"]) -> Bool[np.ndarray, "r r"]:
    """The largest connected part: lips and lids line mouth and eyes too, in charts of their own."""
    from skimage.measure import label

    parts = np.asarray(label(mask, connectivity=1))
    counts = np.bincount(parts.ravel())
    counts[0] = 0
    return parts == counts.argmax()
