"""Names for the parts of a face, found from its 68 landmarks."""

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from jaxface._types import Bool, Float, Int
from jaxface.models.morphable import MorphableModel

REGIONS = (
    "forehead",
    "temples",
    "nose",
    "cheeks",
    "chin",
    "lips",
    "eyelids",
    "scalp",
    "neck",
    "eyes",
    "mouth_interior",
)
"""the bundled model's names; ears count to the scalp, for no landmark lies on them"""

FACE_REGIONS = ("forehead", "temples", "nose", "cheeks", "chin", "lips", "eyelids", "face")
"""skin whose colour the photo term compares: not eyeballs, mouth, ears, scalp or neck"""

OUTLINE_REGIONS = (*FACE_REGIONS, "neck", "ears")
"""skin that may form the outline of the face"""

NOT_SKIN = ("eyes", "mouth_interior")
"""regions that no skin covers"""


def in_regions(model: MorphableModel, names: Sequence[str]) -> Bool[np.ndarray, "n"]:
    """Vertices in any of the named regions; all where the model knows none of them."""
    known = [model.region_names.index(name) for name in names if name in model.region_names]
    if not known:
        return np.ones(model.vertex_count, bool)
    return np.isin(np.asarray(model.region), known)


def label_regions(
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "f 3"],
    landmarks68: Float[np.ndarray, "68 3"],
) -> Int[np.ndarray, "n"]:
    """Index into `REGIONS` of every vertex of a neutral head (mm, +y up, +z forward).

    The head is unrolled about its vertical axis, where loops of landmarks do not fold. The face
    ends at the jaw line and, by the rule of thirds, at a hairline as far above the root of the
    nose as its base is below. Pieces of the mesh that hang together with nothing else are
    eyeballs, where they lie behind the lids, and else the inside of the mouth.
    """
    marks = landmarks68
    axis_z = 0.5 * (marks[0, 2] + marks[16, 2]) - 0.1 * abs(marks[16, 0] - marks[0, 0])
    radius = 0.5 * abs(marks[16, 0] - marks[0, 0])
    centre_x = marks[27:31, 0].mean()

    def unroll(points: np.ndarray) -> np.ndarray:
        azimuth = np.arctan2(points[:, 0] - centre_x, points[:, 2] - axis_z)
        return np.stack([azimuth * radius, points[:, 1]], axis=1)

    flat, flat_marks = unroll(vertices), unroll(marks)
    root, base = flat_marks[27, 1], flat_marks[33, 1]
    brow = flat_marks[17:27]
    arc = np.linspace(0.0, np.pi, 17)
    right, left = flat_marks[0, 0], flat_marks[16, 0]
    hairline = np.stack(
        [
            0.5 * (left + right) + 0.5 * (left - right) * np.cos(arc),
            flat_marks[[0, 16], 1].mean()
            + (2 * root - base - flat_marks[[0, 16], 1].mean()) * np.sin(arc),
        ],
        axis=1,
    )
    front = np.abs(flat[:, 0]) < 0.55 * np.pi * radius
    face = front & inside_polygon(flat, np.concatenate([flat_marks[:17], hairline[1:-1]]))
    lids = [_grown(flat_marks[a : a + 6], 1.5, 2.8) for a in (36, 42)]
    nose = flat_marks[[21, 39, 31, 33, 35, 42, 22]].copy()
    # The landmarks 31 and 35 lie under the nostrils; the wings reach a little further out.
    width = 0.35 * (nose[4, 0] - nose[2, 0])
    nose[[2, 4], 0] += [-width, width]
    nose[[2, 3, 4], 1] -= 2.0
    brow_height = np.interp(flat[:, 0], brow[:, 0], brow[:, 1])
    outer = np.abs(flat_marks[[36, 45], 0]).mean()
    corner = flat_marks[[48, 54]]

    region = np.full(len(vertices), REGIONS.index("scalp"), np.int32)

    def assign(mask: np.ndarray, name: str) -> None:
        region[mask] = REGIONS.index(name)

    assign(~face & (vertices[:, 1] < flat_marks[[2, 14], 1].mean()), "neck")
    assign(face, "cheeks")
    assign(face & (flat[:, 1] > root) & (np.abs(flat[:, 0]) > outer), "temples")
    assign(face & (flat[:, 1] > brow_height) & (np.abs(flat[:, 0]) < 1.1 * outer), "forehead")
    reach = 1.05 * np.abs(corner[:, 0]).mean()
    assign(face & (flat[:, 1] < corner[:, 1].mean()) & (np.abs(flat[:, 0]) < reach), "chin")
    assign(face & (inside_polygon(flat, lids[0]) | inside_polygon(flat, lids[1])), "eyelids")
    assign(face & inside_polygon(flat, nose), "nose")
    assign(face & inside_polygon(flat, _grown(flat_marks[48:60], 1.05, 1.1)), "lips")
    _label_pieces(region, flat, faces, lids)
    return region


def _label_pieces(
    region: np.ndarray, flat: np.ndarray, faces: np.ndarray, lids: list[np.ndarray]
) -> None:
    """Overwrite the labels of every connected piece but the largest."""
    count = len(region)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    pieces, piece = connected_components(graph, directed=False)
    largest = np.argmax(np.bincount(piece))
    for index in range(pieces):
        members = piece == index
        # A few vertices may be left over from an editor; they are nobody's eye.
        if index != largest and members.sum() > 20:
            middle = flat[members].mean(axis=0)[None]
            eye = any(inside_polygon(middle, lid)[0] for lid in lids)
            region[members] = REGIONS.index("eyes" if eye else "mouth_interior")


def _grown(loop: np.ndarray, sideways: float, upward: float) -> np.ndarray:
    """A loop scaled about its middle."""
    middle = loop.mean(axis=0)
    return middle + (loop - middle) * [sideways, upward]


def inside_polygon(
    points: Float[np.ndarray, "n 2"], polygon: Float[np.ndarray, "p 2"]
) -> Bool[np.ndarray, "n"]:
    """Even-odd rule: True where a ray to the right crosses the outline an odd number of times."""
    x, y = points[:, :1], points[:, 1:]
    start, end = polygon, np.roll(polygon, -1, axis=0)
    spans = (start[:, 1] > y) != (end[:, 1] > y)
    rise = end[:, 1] - start[:, 1]
    slope = (end[:, 0] - start[:, 0]) / np.where(rise == 0, 1.0, rise)
    crossing = start[:, 0] + (y - start[:, 1]) * slope
    return np.sum(spans & (x < crossing), axis=1) % 2 == 1
