"""Pictures of results: heat maps with a legend, and contact sheets of titled panels.

Images come in as `jaxface.io.pictures.drawing` takes them and go out as ``(H, W, 3) uint8``.
"""

from collections.abc import Callable, Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from jaxface._types import Bool, Float, Shaped
from jaxface.io.pictures.colourmap import diverging, sequential
from jaxface.io.pictures.drawing import INK, MUTED, PAPER, as_rgb8, draw_text


def heatmap(
    values: Float[np.ndarray, "h w"],
    vmin: float | None = None,
    vmax: float | None = None,
    mask: Bool[np.ndarray, "h w"] | None = None,
    unit: str = "",
    signed: bool = False,
    legend: bool = True,
) -> Shaped[np.ndarray, "h w 3"]:
    """Values in a perceptually even colour map, with a bar that says what they mean.

    Args:
        values: what to show; NaN and what lies outside the mask stay dark.
        vmin: value of the first colour; by default the smallest (signed: minus ``vmax``).
        vmax: value of the last colour; by default the 99.5th percentile.
        mask: where there are values.
        unit: written behind the numbers of the legend.
        signed: use the diverging map, neutral half-way.
        legend: draw the bar at the lower edge, in the image.
    """
    values = np.asarray(values, np.float64)
    shown = np.isfinite(values) if mask is None else np.isfinite(values) & np.asarray(mask, bool)
    inside = values[shown]
    if vmax is None:
        size = np.abs(inside) if signed else inside
        vmax = float(np.percentile(size, 99.5)) if inside.size else 1.0
    if vmin is None:
        vmin = -vmax if signed else float(inside.min()) if inside.size else 0.0
    colours = diverging if signed else sequential
    t = (np.where(shown, values, vmin) - vmin) / max(vmax - vmin, 1e-12)
    out = np.where(shown[..., None], colours(t), np.array(PAPER) / 255.0)
    out = as_rgb8(out)
    return _legend(out, colours, vmin, vmax, unit) if legend else out


def contact_sheet(
    panels: Sequence[tuple[str, Shaped[np.ndarray, "..."]]],
    columns: int | None = None,
    cell: int | None = None,
    heading: str = "",
) -> Shaped[np.ndarray, "h w 3"]:
    """Titled pictures in a grid, each scaled to fit its cell.

    Args:
        panels: (title, image) in reading order.
        columns: pictures to a row; by default the grid nearest to 3:2.
        cell: longer side of a cell (px); by default that of the largest image, 256 to 640.
        heading: a line above all.

    Raises:
        ValueError: there are no panels, or ``columns`` is less than one.
    """
    if not panels or (columns is not None and columns < 1):
        raise ValueError(f"{len(panels)} panels in {columns} columns; at least one of each needed")
    images = [as_rgb8(image) for _, image in panels]
    columns = min(columns or _even_columns(len(images)), len(images))
    rows = -(-len(images) // columns)
    cell = cell or int(np.clip(max(max(i.shape[:2]) for i in images), 256, 640))
    aspects = [i.shape[0] / i.shape[1] for i in images]
    widest, tallest = min(aspects), max(aspects)
    height, width = round(cell * min(1.0, tallest)), round(cell / max(1.0, widest))
    margin, caption = max(8, cell // 32), max(18, cell // 15)
    top = round(caption * 1.6) if heading else 0
    sheet = Image.new(
        "RGB",
        (
            columns * (width + margin) + margin,
            rows * (height + caption + margin) + margin + top,
        ),
        PAPER,
    )
    draw = ImageDraw.Draw(sheet)
    if heading:
        font = ImageFont.load_default(caption * 0.8)
        draw.text((margin, margin), heading, fill=INK, font=font, anchor="lt")
    font = ImageFont.load_default(caption * 0.6)
    for index, ((title, _), image) in enumerate(zip(panels, images, strict=True)):
        left = margin + index % columns * (width + margin)
        upper = margin + top + index // columns * (height + caption + margin)
        draw.text((left, upper + caption * 0.45), title, fill=MUTED, font=font, anchor="lm")
        scale = min(width / image.shape[1], height / image.shape[0])
        size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
        resample = Image.Resampling.LANCZOS if scale < 4 else Image.Resampling.NEAREST
        offset = (left + (width - size[0]) // 2, upper + caption + (height - size[1]) // 2)
        sheet.paste(Image.fromarray(image).resize(size, resample), offset)
    return np.asarray(sheet)


def _even_columns(count: int) -> int:
    """Columns of the grid that is nearest to 3:2 and leaves few cells empty."""

    def cost(columns: int) -> float:
        rows = -(-count // columns)
        return abs(np.log(columns / rows / 1.5)) + 0.5 * (columns * rows - count)

    return min(range(1, count + 1), key=cost)


def _legend(
    image: Shaped[np.ndarray, "h w 3"],
    colours: Callable[[np.ndarray], np.ndarray],
    vmin: float,
    vmax: float,
    unit: str,
) -> Shaped[np.ndarray, "h w 3"]:
    height, width = image.shape[:2]
    size = max(9.0, min(height, width) / 28)
    bar_height, bar_width = max(4, round(size * 0.6)), round(width * 0.34)
    left, upper = round(size * 0.8), height - round(size * 0.8) - bar_height
    if upper - size * 2 < 0 or bar_width < 8:
        return image
    out = image.copy()
    bar = as_rgb8(np.tile(colours(np.linspace(0, 1, bar_width)), (bar_height, 1, 1)))
    out[upper - 1 : upper + bar_height + 1, left - 1 : left + bar_width + 1] = PAPER
    out[upper : upper + bar_height, left : left + bar_width] = bar
    text_y = upper - size * 0.35
    out = draw_text(out, (left, text_y), f"{vmin:.3g}", size, anchor="ls")
    label = f"{vmax:.3g} {unit}".strip()
    return draw_text(out, (left + bar_width, text_y), label, size, anchor="rs")
