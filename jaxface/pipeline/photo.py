"""Photos and masks by path, and the photo that comes with scikit-image."""

import os

import numpy as np

from jaxface._types import Float
from jaxface.io.formats.image import Photo
from jaxface.pipeline.fitting._fit import as_photo

DEMO = "demo"


def demo_photo() -> Photo:
    """Scikit-image's portrait of Eileen Collins (NASA, public domain)."""
    from skimage import data

    return as_photo(data.astronaut())


def open_photo(photo: str | os.PathLike[str]) -> Photo:
    """A photo by path, or the demo by its name."""
    return demo_photo() if str(photo) == DEMO else as_photo(photo)


def read_mask(path: str | os.PathLike[str]) -> Float[np.ndarray, "h w"]:
    """A mask image as values from 0 (not face) to 1 (face)."""
    return as_photo(path).pixels.mean(axis=-1)
