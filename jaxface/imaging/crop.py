"""The square working image of a fit: the face cut out of a photo at a fixed size."""

import math
from typing import NamedTuple

import numpy as np

from jaxface._types import Float


class Crop(NamedTuple):
    """A square cut out of a photo and resized.

    Attributes:
        image: (S, S, 3) linear RGB, float32.
        inside: (S, S) 1 where the photo covers the crop, 0 beyond its border.
        origin: (x, y) of the crop's top-left corner in the photo, pixels.
        side: length of the crop's side in the photo, pixels.
    """

    image: Float[np.ndarray, "s s 3"]
    inside: Float[np.ndarray, "s s"]
    origin: Float[np.ndarray, "2"]
    side: float

    def to_crop(self, points: np.ndarray) -> np.ndarray:
        """Photo pixels to fractions of the crop's side."""
        return (np.asarray(points)[..., :2] - self.origin) / self.side

    def to_photo(self, points: np.ndarray) -> np.ndarray:
        """Fractions of the crop's side to photo pixels."""
        return np.asarray(points) * self.side + self.origin


def crop_face(
    photo: Float[np.ndarray, "h w 3"],
    landmarks: Float[np.ndarray, "l 2"],
    size: int = 512,
    margin: float = 1.35,
) -> Crop:
    """Cut the square around the landmarks, ``margin`` times as wide as they are.

    Shrinking averages the photo's linear light over each pixel of the crop. The 68-point scheme
    ends at the brows, so there the square reaches further up.

    Args:
        photo: linear RGB.
        landmarks: pixels (x, y) in the photo.
        size: side S of the working image.
        margin: side of the square over the larger extent of the landmarks.

    Raises:
        ValueError: the landmarks are not finite, span less than 16 pixels or miss the photo.
    """
    points = np.asarray(landmarks, np.float64)[:, :2]
    if not np.isfinite(points).all():
        raise ValueError("landmarks hold NaN or infinite coordinates; finite pixels are needed")
    low, high = points.min(axis=0), points.max(axis=0)
    if len(points) == 68:
        low = low - np.array([0.0, 0.35]) * (high - low)
    extent = float((high - low).max())
    height, width = photo.shape[:2]
    if extent < 16:
        raise ValueError(f"the landmarks span {extent:.0f} pixels; a face of 16 or more is needed")
    if (high < 0).any() or (low > [width, height]).any():
        raise ValueError(
            f"the landmarks span {low.round()} to {high.round()} px, outside the photo of "
            f"{width}x{height}"
        )
    side = margin * extent
    origin = (low + high) / 2 - side / 2
    x0, y0 = (math.floor(v) - 1 for v in origin)
    x1, y1 = (math.ceil(v + side) + 1 for v in origin)
    inner = photo[max(y0, 0) : min(y1, height), max(x0, 0) : min(x1, width)]
    pad = ((max(-y0, 0), max(y1 - height, 0)), (max(-x0, 0), max(x1 - width, 0)))
    padded = np.pad(inner, (*pad, (0, 0)), mode="edge").astype(np.float32)
    covered = np.pad(np.ones(inner.shape[:2], np.float32), pad)
    start = origin - [x0, y0]
    image = _resize(padded, start, side, size)
    inside = _resize(covered[..., None], start, side, size)[..., 0]
    return Crop(image, (inside > 0.99).astype(np.float32), origin, side)


def _resize(
    image: Float[np.ndarray, "h w c"], start: np.ndarray, side: float, size: int
) -> Float[np.ndarray, "size size c"]:
    """Square of ``side`` pixels at ``start`` (x, y), resampled by a triangle filter."""
    # Whole blocks are averaged first, so that the matrices below stay small for large photos.
    block = max(int(side / size) // 2, 1)
    if block > 1:
        rows, columns = (n // block * block for n in image.shape[:2])
        grid = image[:rows, :columns].reshape(rows // block, block, columns // block, block, -1)
        image, start, side = grid.mean(axis=(1, 3)), start / block, side / block
    down = _weights(image.shape[0], start[1], side, size)
    across = _weights(image.shape[1], start[0], side, size)
    height, width, channels = image.shape
    lines = (down @ image.reshape(height, -1)).reshape(size, width, channels)
    return np.einsum("sw,rwc->rsc", across, lines, optimize=True)


def _weights(count: int, start: float, side: float, size: int) -> np.ndarray:
    """(size, count) rows that average ``count`` pixels into ``size``; each sums to one."""
    scale = side / size
    centres = start + (np.arange(size) + 0.5) * scale
    offset = np.arange(count) + 0.5 - centres[:, None]
    weights = np.maximum(1 - np.abs(offset) / max(scale, 1.0), 0.0)
    return (weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-9)).astype(np.float32)
