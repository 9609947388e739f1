"""MakeHuman body skins: images in the UV layout of its base mesh hm08, and where the model has it.

A skin is a square image of the whole body. A collection may hold only the head, cut from a 2048
px map and turned upright; such a crop is put back into its place.
"""

import os
from importlib.resources import files
from pathlib import Path

import numpy as np

from jaxface._types import Bool, Float
from jaxface.io.formats.image import read_image
from jaxface.models.morphable import MorphableModel

BODY_SIZE = 2048
HEAD_COLUMNS, HEAD_ROWS = (1296, 2048), (352, 1760)
"""where the head lies in a body map of that size (px, y down); crops are turned 90 degrees
clockwise from there"""


def read_skin(
    path: str | os.PathLike[str],
) -> tuple[Float[np.ndarray, "h h 3"], Bool[np.ndarray, "h h"]]:
    """A skin in the body's layout (sRGB-encoded, 0 to 1), and which of its texels are known.

    Args:
        path: a square body map of any size, or a head crop of 1408 x 752 px.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no image, or of another shape.
    """
    pixels = read_image(path).pixels
    height, width = pixels.shape[:2]
    if height == width:
        return pixels, np.ones((height, width), bool)
    rows, columns = HEAD_ROWS[1] - HEAD_ROWS[0], HEAD_COLUMNS[1] - HEAD_COLUMNS[0]
    if (height, width) != (columns, rows):
        raise ValueError(
            f"{path} is {width}x{height} px; a MakeHuman skin is square, a crop of its head "
            f"{rows}x{columns}"
        )
    body = np.zeros((BODY_SIZE, BODY_SIZE, 3), np.float32)
    known = np.zeros((BODY_SIZE, BODY_SIZE), bool)
    place = (slice(*HEAD_ROWS), slice(*HEAD_COLUMNS))
    body[place], known[place] = np.rot90(pixels), True
    return body, known


def atlas_uv(model: MorphableModel) -> Float[np.ndarray, "m 2"]:
    """For each of the model's texture coordinates, that of the same point in hm08's layout.

    Origin bottom-left; NaN where the skins paint nothing (eyes, teeth, tongue).

    Raises:
        ValueError: the model is not the bundled one, the only one this is known of.
    """
    with (
        (files("jaxface.assets") / "makehuman_atlas.npz").open("rb") as file,
        np.load(file) as data,
    ):
        source = data["source_uv"]
    if model.name != "makehuman" or len(source) != model.uv.shape[0]:
        raise ValueError(
            f"model {model.name!r} with {model.uv.shape[0]} texture coordinates; MakeHuman's skins "
            f"fit the bundled model 'makehuman' with {len(source)}"
        )
    return source


def skin_name(path: str | os.PathLike[str]) -> str:
    """Name of a subject from its file's."""
    return "".join(c if c.isalnum() or c in "._-" else "-" for c in Path(path).stem)
