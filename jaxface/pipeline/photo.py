"""Photos and masks by path, and the photo that comes with scikit-image."""

import os
import unicodedata
from pathlib import Path

import numpy as np

from jaxface._types import Float
from jaxface.io.formats.image import Photo, read_image

DEMO = "demo"
PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp", ".exr")


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


def as_photo(photo: str | os.PathLike[str] | Photo | np.ndarray) -> Photo:
    """A photo from a file or an array (``uint8`` or sRGB-encoded floats in [0, 1]).

    Raises:
        ValueError: an array that is not (h, w, 3) of one of these kinds, or has NaN.
        FileNotFoundError: there is no such file.
    """
    if isinstance(photo, Photo):
        return photo
    if not isinstance(photo, np.ndarray):
        return read_image(photo)
    if photo.ndim != 3 or photo.shape[2] != 3:
        raise ValueError(f"the photo has shape {photo.shape}; (height, width, 3) RGB is needed")
    if photo.dtype == np.uint8:
        pixels = photo.astype(np.float32) / 255
    elif np.issubdtype(photo.dtype, np.floating):
        pixels = photo.astype(np.float32)
        if not np.isfinite(pixels).all() or pixels.min() < 0 or pixels.max() > 1:
            raise ValueError("a photo of floats needs finite sRGB-encoded values from 0 to 1")
    else:
        raise ValueError(f"the photo is {photo.dtype}; uint8 or floats in [0, 1] are needed")
    return Photo(pixels, None, None, "array")


def photos_in(folder: str | os.PathLike[str]) -> list[Path]:
    """The photos of a folder, hidden files aside, in the order of their names.

    The order is that of the letters' code points, the same on every machine.

    Raises:
        ValueError: it holds none.
    """
    found = [
        path
        for path in Path(folder).iterdir()
        if path.suffix.lower() in PHOTO_SUFFIXES and not path.name.startswith(".")
    ]
    if not found:
        raise ValueError(f"folder {folder} holds no photo ({', '.join(PHOTO_SUFFIXES)})")
    return sorted(found, key=in_order)


def in_order(photo: Path) -> str:
    """The key that photos are sorted by: their names, letter by letter."""
    # Some file systems take names apart into letters and accents, others put them together.
    return unicodedata.normalize("NFC", photo.name)
