"""Landmarks from and to files: our JSON, iBUG's ``.pts``, and plain text as dlib users keep it.

JSON (schema ``jaxface-landmarks/1``)::

    {"schema": "jaxface-landmarks/1", "scheme": "ibug68", "image_size": [width, height],
     "points": [[x, y], ...]}

``scheme`` is ``ibug68`` or ``mediapipe468``; points may have a third number, a relative depth.
Coordinates are pixels, x right and y down, the centre of the first pixel at (0.5, 0.5). The other
formats count pixel centres from 1 (``.pts``) or 0 (text) and are shifted on reading and writing.
"""

import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxface._types import Float
from jaxface.io.atomic import atomic_path
from jaxface.models.landmark_schemes import SCHEME_SIZES

SCHEMA = "jaxface-landmarks/1"

# What to add to a format's coordinates to put the first pixel's centre at 0.5.
_SHIFTS = {".pts": -0.5, ".txt": 0.5}


@dataclass(frozen=True)
class Landmarks:
    """The points of one face."""

    points: Float[np.ndarray, "n d"]
    """x, y (px) and, where there is one, a relative depth (px)"""
    scheme: str
    """``ibug68`` or ``mediapipe468``"""
    image_size: tuple[int, int] | None
    """width and height of the photo (px), where the file tells"""


def read_landmarks(path: str | os.PathLike[str]) -> Landmarks:
    """Read landmarks; the format goes by the suffix (``.json``, ``.pts``, ``.txt``).

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: another suffix, a file that is not of the format, a wrong number of points,
            or coordinates that are not finite numbers.
    """
    file = Path(path)
    if not file.is_file():
        raise FileNotFoundError(f"there is no file {file}")
    suffix = file.suffix.lower()
    try:
        text = file.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{file} is not a text file: {error}") from error
    if suffix == ".json":
        return _from_json(file, text)
    if suffix == ".pts":
        return _from_rows(file, _pts_rows(file, text), suffix)
    if suffix == ".txt":
        return _from_rows(file, text.split("\n"), suffix)
    raise ValueError(f"{file} has the suffix {suffix!r}; .json, .pts or .txt is needed")


def write_landmarks(path: str | os.PathLike[str], landmarks: Landmarks) -> None:
    """Write landmarks, whole or not at all; the format goes by the suffix.

    ``.pts`` and ``.txt`` hold x and y alone.

    Raises:
        ValueError: another suffix, or points that do not fit their scheme.
    """
    file = Path(path)
    points = _checked("landmarks", landmarks.points, landmarks.scheme)
    suffix = file.suffix.lower()
    if suffix == ".json":
        size = None if landmarks.image_size is None else [int(n) for n in landmarks.image_size]
        record = {"schema": SCHEMA, "scheme": landmarks.scheme, "image_size": size}
        rows = ",\n  ".join(json.dumps([round(float(x), 4) for x in point]) for point in points)
        text = json.dumps(record, indent=1)[:-2] + f',\n "points": [\n  {rows}\n ]\n}}\n'
    elif suffix in _SHIFTS:
        shifted = points[:, :2] - _SHIFTS[suffix]
        text = "".join(f"{x:.4f} {y:.4f}\n" for x, y in shifted)
        if suffix == ".pts":
            text = f"version: 1\nn_points: {len(points)}\n{{\n{text}}}\n"
    else:
        raise ValueError(f"{file} has the suffix {suffix!r}; .json, .pts or .txt is needed")
    with atomic_path(file) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _from_json(file: Path, text: str) -> Landmarks:
    try:
        record = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"{file} is not JSON: {error}") from error
    if not isinstance(record, dict) or record.get("schema") != SCHEMA:
        found = record.get("schema") if isinstance(record, dict) else type(record).__name__
        raise ValueError(f"{file} has the schema {found!r}; {SCHEMA!r} is needed")
    size = record.get("image_size")
    if size is not None and not (
        isinstance(size, list)
        and len(size) == 2
        and all(isinstance(n, int) and n > 0 for n in size)
    ):
        raise ValueError(f"{file}: image_size is {size!r}; [width, height] in pixels is needed")
    points = _checked(str(file), record.get("points"), record.get("scheme"))
    return Landmarks(points, record["scheme"], None if size is None else (size[0], size[1]))


def _pts_rows(file: Path, text: str) -> list[str]:
    head, opening, rest = text.partition("{")
    body, closing, _ = rest.partition("}")
    if not opening or not closing or "n_points" not in head:
        raise ValueError(f"{file} is not a .pts file: 'n_points: N' and {{...}} are needed")
    return body.split("\n")


def _from_rows(file: Path, rows: list[str], suffix: str) -> Landmarks:
    points = []
    for number, row in enumerate(rows, start=1):
        if not row.strip():
            continue
        try:
            x, y = (float(value) for value in row.replace(",", " ").split())
        except ValueError as error:
            raise ValueError(f"{file}: point line {number} is {row!r}; 'x y' is needed") from error
        points.append((x, y))
    schemes = {size: scheme for scheme, size in SCHEME_SIZES.items()}
    if len(points) not in schemes:
        raise ValueError(f"{file} has {len(points)} points; {_wanted()} are needed")
    scheme = schemes[len(points)]
    return Landmarks(_checked(str(file), points, scheme) + _SHIFTS[suffix], scheme, None)


def _checked(name: str, values: object, scheme: object) -> Float[np.ndarray, "n d"]:
    # Points as an array of the right shape, or an error that names the file.
    if scheme not in SCHEME_SIZES:
        raise ValueError(f"{name}: the scheme is {scheme!r}; one of {list(SCHEME_SIZES)} is needed")
    try:
        points = np.asarray(values, np.float64)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{name}: the points are no table of numbers: {error}") from error
    count = SCHEME_SIZES[str(scheme)]
    if points.ndim != 2 or points.shape[0] != count or points.shape[1] not in (2, 3):
        raise ValueError(
            f"{name}: the points have shape {points.shape}; {scheme} needs ({count}, 2 or 3)"
        )
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise ValueError(f"{name}: points {bad.tolist()} are not finite")
    return points


def _wanted() -> str:
    return " or ".join(f"{size} ({scheme})" for scheme, size in SCHEME_SIZES.items())
