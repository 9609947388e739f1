"""Photos from files, and images to files.

A photo is read as float32 RGB, sRGB-encoded, 0 to 1, upright. What the file holds besides (its
transparency, the lens) comes along where it is of use.
"""

import os
import struct
import zlib
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import tifffile
from PIL import ExifTags, Image, ImageCms, ImageOps

from jaxface._types import Float, Shaped
from jaxface.io.atomic import atomic_path
from jaxface.io.formats.exr import read_exr, srgb_encoded

SMALLEST_SIDE = 16
"""px; smaller images are refused"""

_BACKGROUND = 0.5
_PNG_COLOUR_TYPES = {1: 0, 2: 4, 3: 2, 4: 6}


@dataclass(frozen=True)
class Photo:
    """An image file as it was meant to be seen."""

    pixels: Float[np.ndarray, "h w 3"]
    """sRGB-encoded RGB, 0 to 1, row 0 at the top; over mid-grey where the file is transparent"""
    opacity: Float[np.ndarray, "h w"] | None
    """0 to 1, where the file has transparency"""
    focal_35mm: float | None
    """focal length (mm) for a frame 36 mm wide, where the camera told"""
    source: str
    """what was read and how it was converted, for reports"""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, px."""
        return self.pixels.shape[1], self.pixels.shape[0]


def read_image(path: str | os.PathLike[str]) -> Photo:
    """Read a photo: JPEG, PNG, TIFF, WebP and whatever else Pillow reads, or OpenEXR.

    The orientation and the colour profile that the file names are applied. 16-bit values keep
    their precision (but for a profile, which is applied to 8 bits). Float files are linear light
    and are encoded; values beyond white are clipped. Of several frames the first is taken.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no image, is damaged or truncated, is under 16 px, or holds NaN.
    """
    file = Path(path)
    if not file.is_file():
        raise FileNotFoundError(f"there is no file {file}")
    start = file.read_bytes()[:4]
    if start == b"\x76\x2f\x31\x01":
        photo = _finished(file, read_exr(file), None, "OpenEXR, linear light")
    elif start[:2] in (b"II", b"MM") and start[2:] in (b"*\0", b"\0*", b"+\0", b"\0+"):
        photo = _read_tiff(file)
    else:
        photo = _read_with_pillow(file)
    if min(photo.size) < SMALLEST_SIDE:
        raise ValueError(
            f"{file} is {photo.size[0]}x{photo.size[1]} px; at least "
            f"{SMALLEST_SIDE}x{SMALLEST_SIDE} is needed"
        )
    return photo


def write_png(path: str | os.PathLike[str], image: Shaped[np.ndarray, "h w c"]) -> None:
    """Write a PNG, whole or not at all.

    Args:
        path: the file to write.
        image: (h, w) or (h, w, 1 to 4) grey, grey + alpha, RGB or RGBA; ``uint8`` and ``uint16``
            as they are, floats sRGB-encoded 0 to 1 as 8 bits (clipped).

    Raises:
        ValueError: another shape or type, or NaN.
    """
    image = np.asarray(image)
    if image.ndim == 2:
        image = image[..., None]
    if image.ndim != 3 or image.shape[2] not in _PNG_COLOUR_TYPES or not image.size:
        raise ValueError(f"image has shape {image.shape}; (height, width, 1 to 4) is needed")
    if np.issubdtype(image.dtype, np.floating):
        if np.isnan(image).any():
            raise ValueError("image holds NaN")
        image = np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)
    if image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"image is {image.dtype}; uint8, uint16 or floats 0 to 1 are needed")
    with atomic_path(path) as temporary:
        if image.dtype == np.uint8:
            plain = image[..., 0] if image.shape[2] == 1 else image
            Image.fromarray(plain).save(temporary, "PNG")
        else:
            temporary.write_bytes(_png16(image))


def _read_with_pillow(file: Path) -> Photo:
    try:
        with Image.open(file) as image:
            image.load()
            exif = image.getexif()
            profile = image.info.get("icc_profile")
            told = f"{image.format}, {image.mode}"
            upright = ImageOps.exif_transpose(image)
            if image.format == "PNG" and _is_16_bit_colour(file):
                fine = ImageOps.exif_transpose(_low_bytes(file, exif))
                values = np.asarray(upright) * 256.0 + np.asarray(fine)
                if profile is None:
                    return _finished(file, values / 65535, exif, "PNG, 16 bit")
    except (OSError, SyntaxError, EOFError, ValueError, struct.error, zlib.error) as error:
        raise ValueError(f"{file} is not a readable image: {error}") from error
    except Image.DecompressionBombError as error:
        raise ValueError(f"{file} is too large: {error}") from error
    if upright.mode in ("I", "F") or upright.mode.startswith("I;16"):
        values = np.asarray(upright).astype(np.float64) / 65535
        return _finished(file, values[..., None], exif, f"{told}, 16 bit")
    upright, converted = _in_srgb(upright, profile)
    values = np.asarray(upright, np.float32) / 255
    return _finished(file, values, exif, told + converted)


def _is_16_bit_colour(file: Path) -> bool:
    # Bit depth and colour type in the header; 2 is RGB, 6 RGBA.
    with file.open("rb") as opened:
        header = opened.read(26)
    return header[24] == 16 and header[25] in (2, 6)


def _low_bytes(file: Path, exif: Image.Exif) -> Image.Image:
    # Pillow keeps the high byte of each 16-bit value. Told that the bytes come in the other
    # order it keeps the low one.
    with Image.open(file) as image:
        tile = image.tile[0]
        image.tile = [tile._replace(args=str(tile.args).removesuffix("B") + "L")]
        image.load()
        image.getexif()[ExifTags.Base.Orientation] = exif.get(ExifTags.Base.Orientation, 1)
        return image


def _in_srgb(image: Image.Image, profile: bytes | None) -> tuple[Image.Image, str]:
    # RGB or RGBA in sRGB, and what was done for the report.
    transparent = image.mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in image.info
    alpha = image.convert("RGBA").getchannel("A") if transparent else None
    told = ""
    if image.mode in ("P", "PA", "1", "La", "RGBa", "LA"):
        image = image.convert("RGBA" if transparent else "RGB")
    if profile:
        try:
            described = ImageCms.ImageCmsProfile(BytesIO(profile))
            name = ImageCms.getProfileDescription(described).strip()
            if "srgb" not in name.lower():
                base = image.convert("RGB") if image.mode == "RGBA" else image
                target = ImageCms.createProfile("sRGB")
                transform = ImageCms.buildTransform(described, target, base.mode, "RGB")
                image = transform.apply(base)
                told = f", profile {name!r} converted to sRGB"
        except (ImageCms.PyCMSError, OSError):
            told = ", unreadable colour profile ignored"
    image = image.convert("RGB")
    if alpha is not None:
        image.putalpha(alpha)
    return image, told


def _read_tiff(file: Path) -> Photo:
    try:
        with tifffile.TiffFile(file) as opened:
            page = opened.pages.first
            values = page.asarray()
            photometric = page.photometric
            orientation = page.tags.valueof(274, 1)
    except Exception as error:  # the decoders raise all sorts
        raise ValueError(f"{file} is not a readable TIFF image: {error}") from error
    simple = photometric in (tifffile.PHOTOMETRIC.RGB, tifffile.PHOTOMETRIC.MINISBLACK)
    if values.dtype in (np.uint8, np.bool_) or not simple:
        # Palettes, profiles, CMYK and YCbCr: Pillow knows them.
        return _read_with_pillow(file)
    if values.ndim == 3 and page.planarconfig == tifffile.PLANARCONFIG.SEPARATE:
        values = np.moveaxis(values, 0, -1)
    values = _oriented(values, int(orientation))
    if np.issubdtype(values.dtype, np.floating):
        return _finished(file, values, None, "TIFF, linear light")
    bits = np.iinfo(values.dtype).max
    return _finished(file, values / bits, None, f"TIFF, {values.dtype}")


def _oriented(values: Shaped[np.ndarray, "h w *c"], orientation: int) -> Shaped[np.ndarray, "..."]:
    # The eight EXIF orientations: transposed, then flipped.
    if orientation in (5, 6, 7, 8):
        values = np.swapaxes(values, 0, 1)
    if orientation in (3, 4, 7, 8):
        values = values[::-1]
    if orientation in (2, 3, 6, 7):
        values = values[:, ::-1]
    return values


def _finished(
    file: Path, values: Float[np.ndarray, "..."], exif: Image.Exif | None, told: str
) -> Photo:
    # Grey to RGB, transparency over the background, linear light encoded.
    if values.ndim == 2:
        values = values[..., None]
    if values.ndim != 3:
        raise ValueError(f"{file} holds an array of shape {values.shape}, which is no image")
    if not np.isfinite(values).all():
        raise ValueError(f"{file} holds NaN or infinite values")
    channels = values.shape[2]
    colour = values[..., :3] if channels >= 3 else np.repeat(values[..., :1], 3, axis=2)
    opacity = np.clip(values[..., -1], 0, 1).astype(np.float32) if channels in (2, 4) else None
    colour = srgb_encoded(colour) if "linear" in told else np.clip(colour, 0, 1)
    colour = colour.astype(np.float32)
    if opacity is not None:
        if opacity.min() == 1:
            opacity = None
        else:
            colour = colour * opacity[..., None] + _BACKGROUND * (1 - opacity[..., None])
    return Photo(np.ascontiguousarray(colour), opacity, _focal_35mm(exif), told)


def _focal_35mm(exif: Image.Exif | None) -> float | None:
    if exif is None:
        return None
    try:
        camera = exif.get_ifd(ExifTags.IFD.Exif)
        focal = float(camera.get(ExifTags.Base.FocalLengthIn35mmFilm, 0))
    except (ValueError, TypeError, KeyError, ZeroDivisionError, OSError):
        return None
    return focal if np.isfinite(focal) and focal > 0 else None


def _png16(image: Shaped[np.ndarray, "h w c"]) -> bytes:
    # Pillow writes no 16-bit colour. Each row begins with its filter, 0 for none.
    height, width, channels = image.shape
    rows = np.zeros((height, 1 + 2 * width * channels), np.uint8)
    rows[:, 1:] = image.astype(">u2").reshape(height, -1).view(np.uint8)
    header = struct.pack(">IIBBBBB", width, height, 16, _PNG_COLOUR_TYPES[channels], 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(rows.tobytes(), 6)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks
    )
