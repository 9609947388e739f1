"""Points, lines, masks and text drawn over images.

Images come in as ``uint8`` or as floats 0-1 in display (sRGB) values, grey, RGB or RGBA, and go
out as ``(H, W, 3) uint8``. Positions are pixels, x right and y down, pixel centres at +0.5.
"""

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from jaxface._types import Bool, Float, Shaped

Colour = tuple[int, int, int]

INK: Colour = (232, 234, 238)
PAPER: Colour = (24, 26, 30)
MUTED: Colour = (148, 154, 164)
CYAN: Colour = (72, 219, 251)
AMBER: Colour = (255, 190, 60)

_LANDMARK_LINES = [
    (range(0, 17), False),  # jaw
    (range(17, 22), False),  # brows
    (range(22, 27), False),
    (range(27, 31), False),  # nose
    (range(31, 36), False),
    (range(36, 42), True),  # eyes
    (range(42, 48), True),
    (range(48, 60), True),  # lips
    (range(60, 68), True),
]


def as_rgb8(image: Shaped[np.ndarray, "..."]) -> Shaped[np.ndarray, "h w 3"]:
    """An image as 8-bit RGB; transparency is laid over the dark paper colour.

    Raises:
        ValueError: it is not an image of one, three or four channels, or of another dtype.
    """
    image = np.asarray(image)
    if image.dtype == np.bool_:
        image = image.astype(np.float32)
    if image.ndim == 2:
        image = image[..., None]
    if image.ndim != 3 or image.shape[-1] not in (1, 3, 4):
        raise ValueError(f"image has shape {image.shape}; (H, W), or (H, W, 1, 3 or 4) is needed")
    if np.issubdtype(image.dtype, np.floating):
        finite = np.nan_to_num(image, nan=0.0, posinf=1.0, neginf=0.0)
        image = np.round(np.clip(finite, 0.0, 1.0) * 255).astype(np.uint8)
    elif image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    elif image.dtype != np.uint8:
        raise ValueError(f"image has dtype {image.dtype}; uint8, uint16 or a float is needed")
    if image.shape[-1] == 4:
        alpha = image[..., 3:] / 255.0
        image = np.round(alpha * image[..., :3] + (1 - alpha) * np.array(PAPER)).astype(np.uint8)
    return np.array(np.broadcast_to(image, (*image.shape[:2], 3)))


def draw_points(
    image: Shaped[np.ndarray, "..."],
    points: Float[np.ndarray, "n 2"],
    colour: Colour = CYAN,
    radius: float = 2.0,
    outline: bool = True,
) -> Shaped[np.ndarray, "h w 3"]:
    """Smooth discs of a radius in pixels; the outline keeps them visible on any ground.

    Points that are not finite or lie outside the image are left out.
    """
    out = as_rgb8(image).astype(np.float32)
    for x, y in np.asarray(points, np.float64)[:, :2]:
        if outline:
            _paint(out, (x, y), (x, y), radius + 1.0, (0, 0, 0), 0.55)
        _paint(out, (x, y), (x, y), radius, colour, 1.0)
    return np.round(out).astype(np.uint8)


def draw_polyline(
    image: Shaped[np.ndarray, "..."],
    points: Float[np.ndarray, "n 2"],
    colour: Colour = CYAN,
    width: float = 1.5,
    closed: bool = False,
    opacity: float = 1.0,
) -> Shaped[np.ndarray, "h w 3"]:
    """Smooth line of a width in pixels through the points, back to the first where closed."""
    out = as_rgb8(image).astype(np.float32)
    points = np.asarray(points, np.float64)[:, :2]
    ends = np.concatenate([points, points[:1]]) if closed else points
    for start, end in zip(ends[:-1], ends[1:], strict=True):
        _paint(out, tuple(start), tuple(end), width / 2, colour, opacity)
    return np.round(out).astype(np.uint8)


def draw_landmarks(
    image: Shaped[np.ndarray, "..."],
    points: Float[np.ndarray, "n 2"],
    colour: Colour = CYAN,
    radius: float | None = None,
) -> Shaped[np.ndarray, "h w 3"]:
    """Landmarks as points; 68 of them are joined along the jaw, brows, nose, eyes and lips.

    The radius (px) is by default chosen from the extent of the points.
    """
    points = np.asarray(points, np.float64)[:, :2]
    extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    dense = len(points) > 100
    radius = max(0.8, extent / (400 if dense else 180)) if radius is None else radius
    out = as_rgb8(image)
    if len(points) == 68:
        for indices, closed in _LANDMARK_LINES:
            line = points[list(indices)]
            out = draw_polyline(out, line, colour, width=max(1.0, radius * 0.6), closed=closed)
    return draw_points(out, points, colour, radius, outline=not dense)


def tint(
    image: Shaped[np.ndarray, "..."],
    mask: Float[np.ndarray, "h w"] | Bool[np.ndarray, "h w"],
    colour: Colour = AMBER,
    opacity: float = 0.5,
) -> Shaped[np.ndarray, "h w 3"]:
    """Lay a colour over the image where the mask (0-1) is."""
    out = as_rgb8(image).astype(np.float32)
    weight = opacity * np.clip(np.asarray(mask, np.float32), 0, 1)[..., None]
    return np.round(out * (1 - weight) + weight * np.array(colour, np.float32)).astype(np.uint8)


def draw_text(
    image: Shaped[np.ndarray, "..."],
    xy: tuple[float, float],
    text: str,
    size: float = 14.0,
    colour: Colour = INK,
    anchor: str = "lt",
    halo: bool = True,
) -> Shaped[np.ndarray, "h w 3"]:
    """Text of a size in pixels at (x, y); ``anchor`` as pillow has it ("lt" = left, top)."""
    canvas = Image.fromarray(as_rgb8(image))
    ImageDraw.Draw(canvas).text(
        xy,
        text,
        fill=colour,
        font=ImageFont.load_default(size),
        anchor=anchor,
        stroke_width=max(1, round(size / 12)) if halo else 0,
        stroke_fill=(0, 0, 0),
    )
    return np.asarray(canvas)


def _paint(
    out: Float[np.ndarray, "h w 3"],
    start: tuple[float, ...],
    end: tuple[float, ...],
    radius: float,
    colour: Colour,
    opacity: float,
) -> None:
    """Blend a capsule (a segment with round ends) into ``out``, its edge one pixel soft."""
    ends = np.array([start, end])
    if not np.isfinite(ends).all():
        return
    low = np.floor(np.clip(ends.min(axis=0) - radius - 1, 0, None)).astype(int)
    limit = np.array(out.shape[1::-1])
    high = np.minimum(np.ceil(np.minimum(ends.max(axis=0) + radius + 1, limit)), limit).astype(int)
    if (low >= high).any():
        return
    x = np.arange(low[0], high[0]) + 0.5 - ends[0, 0]
    y = (np.arange(low[1], high[1]) + 0.5 - ends[0, 1])[:, None]
    along = ends[1] - ends[0]
    t = np.clip((x * along[0] + y * along[1]) / max(float(along @ along), 1e-12), 0.0, 1.0)
    distance = np.hypot(x - t * along[0], y - t * along[1])
    alpha = (opacity * np.clip(radius + 0.5 - distance, 0.0, 1.0))[..., None]
    patch = out[low[1] : high[1], low[0] : high[0]]
    patch += alpha * (np.array(colour, np.float32) - patch)
