"""Windows of a photo of any size as arrays of fixed size, so that what reads them compiles once.

NumPy, at the edge: the photo's own size never reaches a compiled function. Coordinates are the
photo's pixels, x right and y down, pixel centres at +0.5.
"""

import math

import numpy as np

from jaxface._types import Float, Int, Shaped

_SMALLEST_PHOTO = 16


class PhotoPyramid:
    """A photo and its halves, made when first needed."""

    def __init__(self, photo: Shaped[np.ndarray, "h w 3"]) -> None:
        """Take an sRGB-encoded photo, ``uint8`` or float in [0, 1].

        Raises:
            ValueError: the array is not an RGB photo, is smaller than 16 px, or is not finite.
        """
        if photo.ndim != 3 or photo.shape[2] != 3:
            raise ValueError(f"photo has shape {photo.shape}; (height, width, 3) is needed")
        if min(photo.shape[:2]) < _SMALLEST_PHOTO:
            raise ValueError(
                f"photo is {photo.shape[1]}x{photo.shape[0]} px; at least "
                f"{_SMALLEST_PHOTO}x{_SMALLEST_PHOTO} is needed"
            )
        if photo.dtype != np.uint8:
            if not np.issubdtype(photo.dtype, np.floating):
                raise ValueError(f"photo is {photo.dtype}; uint8 or floats in [0, 1] are needed")
            if not np.isfinite(photo).all():
                raise ValueError("photo holds NaN or infinite values")
        self._photo = photo
        # Halves have the channels first: NumPy is slow on an inner axis of three.
        self._halves: list[Float[np.ndarray, "3 _ _"]] = []

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, px."""
        height, width = self._photo.shape[:2]
        return width, height

    def picture(
        self, corner: tuple[float, float], side: float, size: int
    ) -> Float[np.ndarray, "size size 3"]:
        """The square window of ``side`` px at ``corner`` (x, y), as ``size`` px; black outside.

        Antialiased: halved until less than twice too large, then a triangle filter.
        """
        index = max(0, math.floor(math.log2(side / size)))
        factor = 2**index
        height, width = self._level_shape(index)
        scale = side / factor / size
        rows, row_weights = _taps(height, corner[1] / factor, scale, size)
        columns, column_weights = _taps(width, corner[0] / factor, scale, size)
        top, left = rows.min(), columns.min()
        part = self._part(index, slice(top, rows.max() + 1), slice(left, columns.max() + 1))
        shrunk = np.zeros((3, size, part.shape[2]), np.float32)
        for taps, weights in zip(rows.T, row_weights.T, strict=True):
            shrunk += part[:, taps - top] * weights[:, None]
        result = np.zeros((3, size, size), np.float32)
        for taps, weights in zip(columns.T, column_weights.T, strict=True):
            result += shrunk[:, :, taps - left] * weights
        return np.ascontiguousarray(np.moveaxis(result, 0, -1))

    def patch(
        self, centre: tuple[float, float], reach: float, size: int
    ) -> tuple[Float[np.ndarray, "3 size size"], Float[np.ndarray, "2"], int]:
        """Pixels around ``centre``, not resampled, from the finest level where ``reach`` fits.

        Beyond the border the border pixel goes on.

        Args:
            centre: x, y.
            reach: the patch must show at least that far from the centre on every side, px.
            size: side of the patch.

        Returns:
            The patch (channels first), its corner (x, y) in the pixels of the level, and the factor
            by which the level is smaller: a patch point p is the photo's ``factor * (corner + p)``.
        """
        index = max(0, math.ceil(math.log2(2 * (reach + 1) / size)))
        factor = 2**index
        height, width = self._level_shape(index)
        corner = np.round(np.asarray(centre) / factor - size / 2)
        top, bottom, above, below = _cut(int(corner[1]), size, height)
        left, right, before, after = _cut(int(corner[0]), size, width)
        part = self._part(index, slice(top, bottom), slice(left, right))
        patch = np.pad(part, ((0, 0), (above, below), (before, after)), mode="edge")
        return patch, corner, factor

    def _level_shape(self, index: int) -> tuple[int, int]:
        if index == 0:
            return self._photo.shape[0], self._photo.shape[1]
        while len(self._halves) < index:
            finer = self._halves[-1] if self._halves else np.moveaxis(self._photo, -1, 0)
            self._halves.append(_halve(finer))
        return self._halves[index - 1].shape[1], self._halves[index - 1].shape[2]

    def _part(self, index: int, rows: slice, columns: slice) -> Float[np.ndarray, "3 _ _"]:
        if index:
            return self._halves[index - 1][:, rows, columns]
        scale = np.float32(1 / 255 if self._photo.dtype == np.uint8 else 1)
        part = self._photo[rows, columns]
        return np.stack([np.multiply(part[..., c], scale, dtype=np.float32) for c in range(3)])


def tile_corners(
    width: float, height: float, side: float, overlap: float
) -> list[tuple[float, float]]:
    """Corners (x, y) of square tiles that cover a photo and overlap by at least a share of a side.

    Tiles are spread evenly; along an axis shorter than a tile one tile is centred.
    """

    def starts(length: float) -> list[float]:
        if length <= side:
            return [(length - side) / 2]
        count = math.ceil((length - side) / (side * (1 - overlap))) + 1
        return [float(start) for start in np.linspace(0, length - side, count)]

    return [(left, top) for top in starts(height) for left in starts(width)]


def unturn(points: Float[np.ndarray, "*batch 2"], turns: int, size: float) -> np.ndarray:
    """Where points of a square picture turned by ``np.rot90(picture, turns)`` lie in the picture.

    Args:
        points: x, y in the turned picture.
        turns: quarter turns, counter-clockwise.
        size: side of the picture.
    """
    for _ in range(turns):
        points = np.stack([size - points[..., 1], points[..., 0]], axis=-1)
    return points


def _halve(image: Shaped[np.ndarray, "3 h w"]) -> Float[np.ndarray, "3 h2 w2"]:
    # Means of 2x2 blocks; the last row or column of an odd size is repeated.
    _, height, width = image.shape
    if height % 2 or width % 2:
        image = np.pad(image, ((0, 0), (0, height % 2), (0, width % 2)), mode="edge")
    wide = np.uint16 if image.dtype == np.uint8 else np.float32
    total = np.add(image[:, 0::2, 0::2], image[:, 0::2, 1::2], dtype=wide, casting="same_kind")
    total += image[:, 1::2, 0::2]
    total += image[:, 1::2, 1::2]
    return total * np.float32(0.25 / 255 if wide is np.uint16 else 0.25)


def _taps(
    source: int, start: float, scale: float, size: int
) -> tuple[Int[np.ndarray, "size taps"], Float[np.ndarray, "size taps"]]:
    # One axis of a resize by a triangle filter: the source pixels under each target pixel, and
    # their weights (all zero for a target pixel outside the source).
    centres = start + (np.arange(size) + 0.5) * scale
    support = max(scale, 1.0)
    first = np.floor(centres - support).astype(int)
    taps = first[:, None] + np.arange(math.ceil(2 * support) + 1)
    distance = np.abs(taps + 0.5 - np.clip(centres, 0.5, source - 0.5)[:, None])
    weights = np.maximum(1 - distance / support, 0) * ((taps >= 0) & (taps < source))
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), np.finfo(float).tiny)
    inside = (centres > 0) & (centres < source)
    return np.clip(taps, 0, source - 1), (weights * inside[:, None]).astype(np.float32)


def _cut(start: int, size: int, length: int) -> tuple[int, int, int, int]:
    # The part [start, start + size) of an axis: what exists (one pixel at least), and how many
    # pixels it lacks before and after.
    first = min(max(start, 0), length - 1)
    last = max(min(start + size, length), first + 1)
    before = min(max(-start, 0), size - (last - first))
    return first, last, before, size - before - (last - first)
