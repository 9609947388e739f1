"""Windows of a photo of any size as arrays of fixed size, so that what reads them compiles once.

NumPy, at the edge: the photo's own size never reaches a compiled function. Coordinates are the
photo's pixels, x right and y down, pixel centres at +0.5.
"""

import math

import numpy as np

from jaxface._types import Float, Shaped


class PhotoPyramid:
    """A photo and its halves, made when first needed."""

    def __init__(self, photo: Shaped[np.ndarray, "h w 3"]) -> None:
        """Take an sRGB-encoded photo, ``uint8`` or float in [0, 1].

        Raises:
            ValueError: the array is not an RGB photo, is smaller than 16 px, or is not finite.
        """
        if photo.ndim != 3 or photo.shape[2] != 3:
            raise ValueError(f"photo has shape {photo.shape}; (height, width, 3) is needed")
        if min(photo.shape[:2]) < 16:
            raise ValueError(
                f"photo is {photo.shape[1]}x{photo.shape[0]} px; at least 16x16 is needed"
            )
        if photo.dtype == np.uint8:
            values = photo.astype(np.float32) * np.float32(1 / 255)
        elif np.issubdtype(photo.dtype, np.floating):
            values = photo.astype(np.float32, copy=False)
            if not np.isfinite(values).all():
                raise ValueError("photo holds NaN or infinite values")
        else:
            raise ValueError(f"photo is {photo.dtype}; uint8 or floats in [0, 1] are needed")
        self._levels = [values]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, px."""
        height, width = self._levels[0].shape[:2]
        return width, height

    def level(self, index: int) -> Float[np.ndarray, "h w 3"]:
        """The photo divided by ``2**index``; it is never made smaller than 2 px."""
        while len(self._levels) <= index:
            self._levels.append(_halve(self._levels[-1]))
        return self._levels[index]

    def picture(
        self, corner: tuple[float, float], side: float, size: int
    ) -> Float[np.ndarray, "size size 3"]:
        """The square window of ``side`` px at ``corner`` (x, y), as ``size`` px; black outside.

        Antialiased: halved until less than twice too large, then a triangle filter.
        """
        index = max(0, math.floor(math.log2(side / size)))
        image = self.level(index)
        scale = side / 2**index / size
        x, y = (c / 2**index for c in corner)
        rows = _window_weights(image.shape[0], y, scale, size)
        columns = _window_weights(image.shape[1], x, scale, size)
        (top, row_weights), (left, column_weights) = rows, columns
        part = image[
            top : top + row_weights.shape[1], left : left + column_weights.shape[1]
        ]
        shrunk = np.tensordot(row_weights, part, 1)
        return np.ascontiguousarray(
            np.tensordot(column_weights, shrunk, (1, 1)).transpose(1, 0, 2), np.float32
        )

    def patch(
        self, centre: tuple[float, float], reach: float, size: int
    ) -> tuple[Float[np.ndarray, "size size 3"], Float[np.ndarray, "2"], int]:
        """Pixels around ``centre``, not resampled, from the finest level where ``reach`` fits.

        Beyond the border the border pixel goes on.

        Args:
            centre: x, y.
            reach: the patch must show at least that far from the centre on every side, px.
            size: side of the patch.

        Returns:
            The patch, its corner (x, y) in the pixels of the level, and the factor by which the
            level is smaller: a patch point p is the photo's ``factor * (corner + p)``.
        """
        index = max(0, math.ceil(math.log2(2 * (reach + 1) / size)))
        image = self.level(index)
        factor = 2**index
        corner = np.round(np.asarray(centre) / factor - size / 2)
        steps = np.arange(size)
        rows = np.clip(int(corner[1]) + steps, 0, image.shape[0] - 1)
        columns = np.clip(int(corner[0]) + steps, 0, image.shape[1] - 1)
        return image[rows[:, None], columns], corner, factor


def _halve(image: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "h2 w2 c"]:
    height, width = image.shape[:2]
    if height % 2 or width % 2:
        image = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    rows = image[0::2] + image[1::2]
    return (rows[:, 0::2] + rows[:, 1::2]) * np.float32(0.25)


def _window_weights(
    source: int, start: float, scale: float, size: int
) -> tuple[int, Float[np.ndarray, "size part"]]:
    # One axis of a resize: the first source pixel that is used, and the weights from there on.
    centres = start + (np.arange(size) + 0.5) * scale
    support = max(scale, 1.0)
    first = int(np.clip(math.floor(centres[0] - support), 0, source - 1))
    last = int(np.clip(math.ceil(centres[-1] + support), first + 1, source))
    clamped = np.clip(centres, 0.5, source - 0.5)
    distance = np.abs(np.arange(first, last) + 0.5 - clamped[:, None])
    weights = np.maximum(1 - distance / support, 0)
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), np.finfo(float).tiny)
    inside = (centres > 0) & (centres < source)
    return first, (weights * inside[:, None]).astype(np.float32)
