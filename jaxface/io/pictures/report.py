"""The report of a run: report.json for programs and a report.html that stands alone."""

import base64
import io
import json
import math
import os
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from PIL import Image

from jaxface.io.atomic import atomic_path
from jaxface.io.pictures.chart import convergence_svg

SCHEMA = 1
PREVIEW_SIZE = 1600


def write_report(out_dir: str | os.PathLike[str], data: Mapping[str, Any]) -> tuple[Path, Path]:
    """Write ``report.html`` and ``report.json`` into a folder.

    Every key of ``data`` is optional, and keys beyond these go into the JSON unchanged. Arrays
    become lists, numbers that are not finite become null.

    - ``title``, ``subtitle``: text.
    - ``figures``: list of ``{"label", "value", "unit"}``, the numbers worth seeing first.
    - ``warnings``: list of text.
    - ``images``: list of ``{"title", "file"}``, file names relative to the folder; the first is
      shown large.
    - ``energies``: list, in the order solved, of ``{"name", "terms": {term: [value, ..]}}``,
      weighted values before each step and after the last.
    - ``timings``: list of ``{"name", "seconds", "compile_seconds"}``.
    - ``tables``: list of ``{"title", "rows": [[cell, ..], ..], "header": [cell, ..]}``; pose,
      camera and the like.
    - ``licences``: list of ``{"name", "what", "licence"}`` of model and data.
    - ``files``: list of ``{"file", "what"}``, what the folder holds.

    - ``environment``: versions and hardware, as `run.environment.environment` has them.

    The schema version and the date are added.

    Returns:
        Paths of the HTML and of the JSON file.

    Raises:
        ValueError: an entry lacks a key that it needs; the message names both.
    """
    folder = Path(out_dir)
    _check(data)
    content = {
        "schema": SCHEMA,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        **plain(data),
    }
    json_path, html_path = folder / "report.json", folder / "report.html"
    with atomic_path(json_path) as path:
        path.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    with atomic_path(html_path) as path:
        path.write_text(render_html(content, folder), encoding="utf-8")
    return html_path, json_path


def render_html(content: Mapping[str, Any], folder: Path) -> str:
    """The page for what ``report.json`` holds; pictures are read from the folder and embedded."""
    source = resources.files("jaxface") / "assets" / "report.html.j2"
    settings = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    settings.filters["number"] = format_number
    settings.filters["seconds"] = format_seconds
    images = [
        {**image, "data": _preview(folder / image["file"])}
        for image in content.get("images", [])
        if (folder / image["file"]).is_file()
    ]
    files = [
        {**entry, "bytes": (folder / entry["file"]).stat().st_size}
        for entry in content.get("files", [])
        if (folder / entry["file"]).is_file()
    ]
    timings = content.get("timings", [])
    longest = max([_duration(t) for t in timings], default=0.0)
    levels = content.get("energies", [])
    return settings.from_string(source.read_text(encoding="utf-8")).render(
        **{**content, "images": images, "files": files},
        chart=convergence_svg(levels),
        term_names=list(dict.fromkeys(name for level in levels for name in level["terms"])),
        longest=longest or 1.0,
        total_run=sum(t.get("seconds") or 0.0 for t in timings),
        total_compile=sum(t.get("compile_seconds") or 0.0 for t in timings),
    )


def plain(value: Any) -> Any:
    """A value as JSON has it: arrays as lists, what is not finite as null, paths as their name.

    Raises:
        TypeError: the value has no such form.
    """
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(entry) for entry in value]
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, os.PathLike):
        return Path(value).name
    if hasattr(value, "__array__"):
        array = np.asarray(value)
        if array.dtype == object:
            raise TypeError(f"an array of objects has no form in JSON: {value!r}")
        return plain(array.tolist())
    raise TypeError(f"{type(value).__name__} has no form in JSON: {value!r}")


def format_number(value: Any) -> str:
    """A number with four significant digits, a list joined by spaces, a dash for null."""
    if value is None:
        return "–"
    if isinstance(value, list):
        return "  ".join(format_number(entry) for entry in value)
    if isinstance(value, float):
        return f"{value:.4g}".replace("-", "\N{MINUS SIGN}")
    return str(value)


def format_seconds(value: float | None) -> str:
    """A duration in milliseconds below one second."""
    if value is None:
        return "–"
    return f"{value:.2f} s" if value >= 1 else f"{value * 1e3:.0f} ms"


def _duration(timing: Mapping[str, Any]) -> float:
    return (timing.get("seconds") or 0.0) + (timing.get("compile_seconds") or 0.0)


def _check(data: Mapping[str, Any]) -> None:
    needed = {
        "figures": ("label", "value"),
        "images": ("title", "file"),
        "energies": ("terms",),
        "timings": ("name", "seconds"),
        "tables": ("title", "rows"),
        "licences": ("name", "licence"),
        "files": ("file", "what"),
    }
    for section, keys in needed.items():
        for entry in data.get(section, ()):
            missing = [key for key in keys if key not in entry]
            if missing:
                raise ValueError(f"report: an entry of {section!r} needs {missing}: {entry!r}")


def _preview(path: Path) -> str:
    """A picture as a data URI, made smaller where it is larger than a screen."""
    with Image.open(path) as image:
        if max(image.size) <= PREVIEW_SIZE and path.suffix.lower() in (".png", ".jpg", ".jpeg"):
            kind = "png" if path.suffix.lower() == ".png" else "jpeg"
            encoded = path.read_bytes()
        else:
            image.thumbnail((PREVIEW_SIZE, PREVIEW_SIZE), Image.Resampling.LANCZOS)
            buffer = io.BytesIO()
            kind = "png" if image.mode in ("RGBA", "LA", "P") else "jpeg"
            image.save(buffer, kind, **({} if kind == "png" else {"quality": 90}))
            encoded = buffer.getvalue()
    return f"data:image/{kind};base64,{base64.b64encode(encoded).decode('ascii')}"
