"""The square working image of a fit: the face cut out of a photo at a fixed size."""

import math
from typing import NamedTuple

import numpy as np
from PIL import Image

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
    box = (origin[0] - x0, origin[1] - y0, origin[0] - x0 + side, origin[1] - y0 + side)

    def resize(channel: np.ndarray) -> np.ndarray:
        picture = Image.fromarray(np.ascontiguousarray(channel), mode=None)
        return np.asarray(picture.resize((size, size), Image.Resampling.HAMMING, box=box))

    image = np.stack([resize(padded[..., c]) for c in range(3)], axis=-1)
    return Crop(image, (resize(covered) > 0.99).astype(np.float32), origin, side)
