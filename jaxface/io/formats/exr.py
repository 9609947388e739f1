"""OpenEXR files: linear-light float images, half or single precision."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import OpenEXR

from jaxface._types import Float, Shaped
from jaxface.io.atomic import atomic_path

_USUAL_ORDER = ("R", "G", "B", "A")
_USUAL_NAMES = {1: ("Y",), 3: ("R", "G", "B"), 4: ("R", "G", "B", "A")}


def write_exr(
    path: str | os.PathLike[str],
    image: Float[np.ndarray, "h w c"],
    half: bool = True,
    channels: Sequence[str] | None = None,
) -> None:
    """Write a float image, ZIP-compressed, whole or not at all.

    Args:
        path: the file to write.
        image: (h, w) or (h, w, c), row 0 at the top.
        half: 16-bit floats (up to 65504, 11 bits of precision); else 32-bit.
        channels: their names; by default Y, RGB or RGBA for 1, 3 or 4 channels.

    Raises:
        ValueError: the shape does not fit the names, or a value is not finite or too large.
    """
    image = np.asarray(image)
    if image.ndim == 2:
        image = image[..., None]
    if image.ndim != 3 or not image.size:
        raise ValueError(f"image has shape {image.shape}; (height, width, channels) is needed")
    names = _USUAL_NAMES.get(image.shape[2]) if channels is None else tuple(channels)
    if names is None or len(names) != image.shape[2]:
        raise ValueError(
            f"image has {image.shape[2]} channels but the names are {names}; 1, 3 or 4 channels, "
            "or one name for each, are needed"
        )
    dtype = np.float16 if half else np.float32
    limit = float(np.finfo(dtype).max)
    # A NaN fails the comparison too.
    if not np.all(np.abs(image) <= limit):
        raise ValueError(
            f"image has values that are not finite or beyond {limit:.6g}, the largest "
            f"{np.dtype(dtype).name}"
        )
    planes = {name: np.ascontiguousarray(image[..., i], dtype) for i, name in enumerate(names)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with atomic_path(path) as temporary:
        OpenEXR.File(header, planes).write(str(temporary))


def read_exr(path: str | os.PathLike[str]) -> Float[np.ndarray, "h w c"]:
    """Read the first part of a file as float32, channels in the order R, G, B, A, then by name.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not an EXR image, is damaged, or has subsampled channels.
    """
    file = Path(path)
    if not file.is_file():
        raise FileNotFoundError(f"there is no file {file}")
    try:
        with OpenEXR.File(str(file), separate_channels=True) as opened:
            planes = {name: np.asarray(c.pixels) for name, c in opened.channels().items()}
    except Exception as error:  # OpenEXR raises whatever its C++ side throws
        raise ValueError(f"{file} is not a readable EXR image: {error}") from error
    names = sorted(
        planes,
        key=lambda name: (
            (_USUAL_ORDER.index(name), "") if name in _USUAL_ORDER else (len(_USUAL_ORDER), name)
        ),
    )
    if not names or len({planes[name].shape for name in names}) != 1:
        raise ValueError(f"{file} has channels {names} of different sizes or none at all")
    return np.stack([planes[name] for name in names], axis=-1).astype(np.float32)


def srgb_encoded(linear: Shaped[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Encode linear light, clipped to [0, 1], as sRGB (IEC 61966-2-1), in NumPy."""
    light = np.clip(linear, 0, 1)
    curve = 1.055 * light ** (1 / 2.4) - 0.055
    return np.where(light <= 0.0031308, 12.92 * light, curve).astype(np.float32)
