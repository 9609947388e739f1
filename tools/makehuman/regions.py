"""Region label of every vertex, from its mesh part, its place in the layout and landmarks."""

import numpy as np
from matplotlib.path import Path

from jaxface.models.landmark_schemes import FACE_OVAL, LIPS_OUTER
from makehuman.topology import HeadMesh

REGIONS = (
    "forehead",
    "temples",
    "nose",
    "cheeks",
    "chin",
    "lips",
    "eyelids",
    "scalp",
    "ears",
    "neck",
    "eyes",
    "mouth_interior",
)
# Loops of the 468 points, chosen for this labelling.
LIDS = (
    (226, 113, 225, 224, 223, 222, 221, 189, 244, 233, 232, 231, 230, 229, 228, 31),
    (446, 342, 445, 444, 443, 442, 441, 413, 464, 453, 452, 451, 450, 449, 448, 261),
)
NOSE = (
    168,
    193,
    245,
    188,
    174,
    217,
    209,
    129,
    64,
    98,
    97,
    2,
    326,
    327,
    294,
    358,
    429,
    437,
    399,
    412,
    465,
    417,
)
BROW_LOWER_EDGE = (8, 285, 295, 282, 283, 276)
JAW_LINE = (152, 377, 400, 378, 379, 365, 397, 288, 361)
TEMPLE_TOP = (10, 338, 297, 332, 284, 251)
JAW_MARGIN = 5.0  # mm: the jaw belongs to cheeks and chin, its underside to the neck
CYLINDER_RADIUS = 80.0  # mm: scale of azimuth in the unrolled view
# The ears' dense rosettes in hm08's own UV layout: centres (u, v) and radius.
EARS_UV = ((0.845, 0.3405), (0.845, 0.6258))
EAR_RADIUS_UV = 0.026


def label_regions(head: HeadMesh, mean: np.ndarray, marks: np.ndarray) -> np.ndarray:
    """Index into ``REGIONS`` (n,) of every vertex.

    Loops of landmarks are tested in a cylindrical view (azimuth about the head's vertical axis,
    height), where the face is seen without folds.

    Args:
        head: the mesh.
        mean: vertices (n, 3), mm.
        marks: the 468 points (468, 3) on the mean.
    """
    axis_z = np.median(mean[head.part == "head", 2])

    def unroll(points: np.ndarray) -> np.ndarray:
        azimuth = np.arctan2(points[:, 0], points[:, 2] - axis_z)
        return np.stack([azimuth * CYLINDER_RADIUS, points[:, 1]], axis=1)

    flat, flat_marks = unroll(mean), unroll(marks)

    def within(loop: tuple[int, ...]) -> np.ndarray:
        return Path(flat_marks[list(loop)]).contains_points(flat)

    def line(loop: tuple[int, ...]) -> np.ndarray:
        """Height of a landmark line at each vertex's |azimuth|."""
        x, y = np.abs(flat_marks[list(loop), 0]), flat_marks[list(loop), 1]
        order = np.argsort(x)
        return np.interp(np.abs(flat[:, 0]), x[order], y[order])

    region = np.full(len(mean), REGIONS.index("scalp"))

    def assign(mask: np.ndarray, name: str) -> None:
        region[mask] = REGIONS.index(name)

    skin = head.part == "head"
    height, side = mean[:, 1], np.abs(flat[:, 0])
    brow_tail = np.abs(flat_marks[[46, 276], 0]).mean()
    outer_canthus = flat_marks[[33, 263]]
    eye_level = outer_canthus[:, 1].mean()
    corner = marks[[61, 291]]
    ear = np.zeros(len(mean), bool)
    for centre in EARS_UV:
        near = np.linalg.norm(head.source_uv - centre, axis=1) < EAR_RADIUS_UV
        ear[head.quads[near[head.uv_quads] & (head.uv_quads >= 0)]] = True
    ear &= skin
    before_ears = side < np.abs(flat[ear, 0]).min()
    top = np.where(side < brow_tail, marks[10, 1], line(TEMPLE_TOP))
    face = skin & (
        within(FACE_OVAL) | (before_ears & (height > line(JAW_LINE) - JAW_MARGIN) & (height < top))
    )
    assign(skin & (height < marks[[132, 361], 1].mean()), "neck")
    assign(face, "cheeks")
    assign(face & (height > eye_level), "temples")
    assign(face & (height > eye_level) & (side < np.abs(outer_canthus[:, 0]).mean()), "eyelids")
    assign(face & (height > line(BROW_LOWER_EDGE)) & (side < brow_tail), "forehead")
    assign(
        face
        & (height < corner[:, 1].mean())
        & (np.abs(mean[:, 0]) < 1.05 * np.abs(corner[:, 0]).mean()),
        "chin",
    )
    assign(skin & within(NOSE) & (mean[:, 2] > axis_z), "nose")
    assign(face & (within(LIDS[0]) | within(LIDS[1])), "eyelids")
    assign(face & within(LIPS_OUTER), "lips")
    assign(ear, "ears")
    assign(np.char.startswith(head.part, "eye_cavity"), "eyelids")
    assign(np.char.startswith(head.part, "neck"), "neck")
    assign(np.isin(head.part, ["eye_l", "eye_r"]), "eyes")
    assign(
        (head.part == "mouth_cavity") | np.char.startswith(head.part, "helper"), "mouth_interior"
    )
    return region
