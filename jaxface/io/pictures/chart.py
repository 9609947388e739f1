"""The convergence plot of a report: an SVG that needs neither scripts nor files."""

import math
from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any

WIDTH, HEIGHT = 920, 340
LEFT, RIGHT, TOP, BOTTOM = 64, 168, 26, 40
SERIES = 6  # colours there are


def convergence_svg(levels: Sequence[Mapping[str, Any]]) -> str:
    """Value of each term against the iteration, on a logarithmic axis, level after level.

    Args:
        levels: one mapping for each pyramid level in the order they were solved, with
            ``"terms": {name: [value before each step .., last value]}`` and optionally ``"name"``.

    Returns:
        An ``<svg>`` element, whose colours are the CSS classes ``series-0``, ``series-1`` ..;
        the empty string where there is nothing positive and finite to show.
    """
    names = list(dict.fromkeys(name for level in levels for name in level["terms"]))
    counts = [max((len(v) for v in level["terms"].values()), default=0) for level in levels]
    shown = [v for level in levels for series in level["terms"].values() for v in series]
    shown = [v for v in shown if v is not None and math.isfinite(v) and v > 0]
    if not shown:
        return ""
    low = math.floor(math.log10(min(shown)) * 2) / 2
    high = max(math.ceil(math.log10(max(shown)) * 2) / 2, low + 0.5)
    total = sum(counts)

    def x(index: float) -> float:
        return LEFT + (WIDTH - LEFT - RIGHT) * (index + 0.5) / max(total, 1)

    def y(value: float) -> float:
        return TOP + (HEIGHT - TOP - BOTTOM) * (high - math.log10(value)) / (high - low)

    parts = _grid(low, high, y)
    start = 0
    for number, (level, count) in enumerate(zip(levels, counts, strict=True)):
        if number:
            edge = x(start - 0.5)
            parts.append(_line("level", edge, TOP - 12, edge, HEIGHT - BOTTOM))
        label = level.get("name") or f"level {number + 1}"
        parts.append(_text("tick", x(start + (count - 1) / 2), HEIGHT - 14, label, "middle"))
        start += count
    lasts: list[tuple[float, int, str]] = []
    for position, name in enumerate(names):
        series = position % SERIES
        start, last = 0, None
        for level, count in zip(levels, counts, strict=True):
            points = [
                (x(start + i), y(v), v)
                for i, v in enumerate(level["terms"].get(name, ()))
                if v is not None and math.isfinite(v) and v > 0
            ]
            parts += _series(series, name, points)
            last = points[-1][1] if points else last
            start += count
        if last is not None:
            lasts.append((last, series, name))
    parts += _labels(lasts)
    return (
        f'<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
        f'aria-label="Energy terms by iteration">{"".join(parts)}</svg>'
    )


def _grid(low: float, high: float, y: Callable[[float], float]) -> list[str]:
    parts = []
    span = high - low
    step = 1 if span > 1 else 0.5
    stride = max(1, math.ceil(span / step / 8))
    tick = math.ceil(low / step) * step
    while tick <= high + 1e-9:
        height = y(10.0**tick)
        parts.append(_line("grid", LEFT, height, WIDTH - RIGHT, height))
        parts.append(_text("tick", LEFT - 10, height + 4, f"{10.0**tick:.2g}", "end"))
        tick += step * stride
    return parts


def _series(series: int, name: str, points: Sequence[tuple[float, float, float]]) -> list[str]:
    if not points:
        return []
    path = " ".join(f"{px:.1f},{py:.1f}" for px, py, _ in points)
    parts = [f'<polyline class="series-{series}" points="{path}"/>']
    radius = 3 if len(points) < 60 else 1.5
    for px, py, value in points:
        title = f"<title>{escape(name)}: {value:.6g}</title>"
        dot = f'<circle class="series-{series}" cx="{px:.1f}" cy="{py:.1f}" r="{radius}">'
        parts.append(f"{dot}{title}</circle>")
    return parts


def _labels(lasts: list[tuple[float, int, str]]) -> list[str]:
    """Names at the right end of their curves, moved apart where they would overlap."""
    parts, below = [], -math.inf
    for height, series, name in sorted(lasts):
        below = max(height + 4, below + 17)
        parts.append(_text(f"name series-{series}", WIDTH - RIGHT + 12, below, name, "start"))
    return parts


def _line(kind: str, x1: float, y1: float, x2: float, y2: float) -> str:
    return f'<line class="{kind}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'


def _text(kind: str, x: float, y: float, content: str, anchor: str) -> str:
    where = f'x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"'
    return f'<text class="{kind}" {where}>{escape(content)}</text>'
