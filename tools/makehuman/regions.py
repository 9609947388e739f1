"""Region label of every vertex, from its mesh part, the ear sliders' support and the landmarks."""

import numpy as np
from matplotlib.path import Path

from makehuman.topology import HeadMesh

REGIONS = ("forehead", "temples", "nose", "cheeks", "chin", "lips", "eyelids", "scalp", "ears",
           "neck", "eyes", "mouth_interior")
LIPS = (61, 146, 91, 181, 84, 17, 314, 405, 321, 375, 291, 409, 270, 269, 267, 0, 37, 39, 40, 185)
LIDS = ((226, 113, 225, 224, 223, 222, 221, 189, 244, 233, 232, 231, 230, 229, 228, 31),
        (446, 342, 445, 444, 443, 442, 441, 413, 464, 453, 452, 451, 450, 449, 448, 261))
NOSE = (168, 193, 245, 188, 174, 217, 209, 129, 64, 98, 97, 2, 326, 327, 294, 358, 429, 437, 399,
        412, 465, 417)
OVAL = (10, 338, 297, 332, 284, 251, 389, 356, 454, 323, 361, 288, 397, 365, 379, 378, 400, 377,
        152, 148, 176, 149, 150, 136, 172, 58, 132, 93, 234, 127, 162, 21, 54, 103, 67, 109)


def label_regions(
    head: HeadMesh, mean: np.ndarray, mesh468: np.ndarray, ear: np.ndarray
) -> np.ndarray:
    """Index into ``REGIONS`` (n,) of every vertex.

    Polygons of landmarks are tested in a cylindrical view of the head (azimuth about the vertical
    axis and height), where the face is a disc without folds seen from the front.
    """
    axis = np.array([0.0, 0.0, np.median(mean[head.part == "head", 2])])

    def unroll(points: np.ndarray) -> np.ndarray:
        offset = points - axis
        return np.stack([np.arctan2(offset[:, 0], offset[:, 2]) * 80.0, points[:, 1]], axis=1)

    flat, marks = unroll(mean), unroll(mesh468)

    def within(loop: tuple[int, ...]) -> np.ndarray:
        return Path(marks[list(loop)]).contains_points(flat)

    region = np.full(len(mean), REGIONS.index("scalp"))

    def assign(mask: np.ndarray, name: str) -> None:
        region[mask] = REGIONS.index(name)

    skin = np.isin(head.part, ["head"])
    face = skin & within(OVAL)
    brow_tail = np.abs(mesh468[[70, 300], 0]).mean()
    brow_top = np.interp(
        np.abs(mean[:, 0]), np.abs(mesh468[[336, 296, 334, 293, 300], 0]),
        mesh468[[336, 296, 334, 293, 300], 1]
    )
    cheek_top = mesh468[[127, 356], 1].mean()
    mouth_corner = mesh468[[61, 291]]
    assign(skin & (mean[:, 1] < mesh468[[132, 361], 1].mean()), "neck")
    assign(face, "cheeks")
    assign(face & (mean[:, 1] > brow_top), "forehead")
    assign(face & (np.abs(mean[:, 0]) > brow_tail) & (mean[:, 1] > cheek_top), "temples")
    assign(face & (mean[:, 1] < mouth_corner[:, 1].mean())
           & (np.abs(mean[:, 0]) < np.abs(mouth_corner[:, 0]).mean()), "chin")
    assign(skin & within(NOSE), "nose")
    assign(face & (within(LIDS[0]) | within(LIDS[1])), "eyelids")
    assign(skin & within(LIPS) & (mean[:, 2] > mesh468[[61, 291], 2].mean() - 6), "lips")
    assign(ear, "ears")
    assign(np.char.startswith(head.part, "eye_cavity"), "eyelids")
    assign(head.part == "neck", "neck")
    assign(np.isin(head.part, ["eye_l", "eye_r"]), "eyes")
    assign((head.part == "mouth_cavity") | np.char.startswith(head.part, "helper"),
           "mouth_interior")
    return region
