"""The 68 landmarks of a mesh, from the several files people keep them in."""

import json
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxface._types import Int
from jaxface.io.face_models.assemble import ModelFormatError, require
from jaxface.io.formats.restricted_pickle import load_npy, load_npz, load_pickle
from jaxface.models.morphable import SurfacePoints

_Point = tuple[tuple[int, int, int], tuple[float, float, float]]

_FACE_KEYS = ("full_lmk_faces_idx", "lmk_faces_idx", "lmk_face_idx", "static_lmk_faces_idx")
_WEIGHT_KEYS = ("full_lmk_bary_coords", "lmk_b_coords", "lmk_bary_coords", "static_lmk_bary_coords")


def vertex_points(indices: Sequence[int] | Int[np.ndarray, "l"]) -> SurfacePoints:
    """Landmarks that are vertices."""
    table = np.repeat(np.asarray(indices, np.int32)[:, None], 3, axis=1)
    weights = np.tile(np.array([1.0, 0.0, 0.0], np.float32), (len(table), 1))
    return SurfacePoints(jnp.asarray(table), jnp.asarray(weights))


def read_landmarks68(
    path: str | Path | Sequence[str | Path] | None,
    faces: Int[np.ndarray, "f 3"],
    vertex_count: int,
    *,
    contours: str | Path | None = None,
    definitions: Mapping[str, int] | None = None,
) -> SurfacePoints | None:
    """The 68 iBUG points on a mesh, or None where the sources name too few of them.

    Understood are: 68 vertex indices (``.txt``, ``.json``, ``.npy``, or an ``.npz`` with
    ``landmarks68``); an embedding of triangles and barycentric weights under FLAME's usual names
    (``lmk_faces_idx`` and ``lmk_b_coords`` and their variants; ``.npz``, ``.npy``, ``.pkl``) of
    68 points, of the inner 51, or of the 17 of the jaw for several head turns, whose first row is
    the frontal one; and eos's mapping from point number to vertex (``.txt`` or ``.toml``).
    Several files add up.

    Args:
        path: a file or several; None leaves ``definitions`` alone.
        faces: the triangles an embedding refers to, in the file's order.
        vertex_count: number of vertices.
        contours: eos's contour lists: fill the jaw line (points 1-8 and 10-17), evenly by index.
        definitions: ``{"1": vertex, ...}`` as eos models carry them.

    Raises:
        ValueError: a file is in none of these forms, or an index is out of range.
    """
    points: dict[int, _Point] = {}
    for key, vertex in (definitions or {}).items():
        if key.isdecimal() and 1 <= int(key) <= 68:
            points[int(key) - 1] = _vertex(vertex)
    paths = [] if path is None else [path] if isinstance(path, str | Path) else list(path)
    for one in paths:
        points.update(_read(Path(one), faces))
    if contours is not None:
        for number, point in _contour_points(Path(contours)).items():
            points.setdefault(number, point)
    _fill_mouth_corners(points)
    source = paths[0] if paths else "landmark definitions"
    for number, (vertices, _) in points.items():
        require(
            0 <= min(vertices) and max(vertices) < vertex_count,
            source,
            f"landmark {number + 1} on vertex {max(vertices, key=abs)}",
            f"vertices 0 to {vertex_count - 1}",
        )
    missing = [number + 1 for number in range(68) if number not in points]
    if missing:
        if points:
            warnings.warn(
                f"{source}: no vertex for points {missing} of the 68; the model is loaded "
                "without landmarks, `jaxface model embed-landmarks` finds them",
                stacklevel=3,
            )
        return None
    table = [points[number] for number in range(68)]
    return SurfacePoints(
        jnp.asarray([vertices for vertices, _ in table], jnp.int32),
        jnp.asarray([weights for _, weights in table], jnp.float32),
    )


def _vertex(index: int) -> _Point:
    return (int(index), int(index), int(index)), (1.0, 0.0, 0.0)


def _read(path: Path, faces: np.ndarray) -> dict[int, _Point]:
    kind = path.suffix.lower()
    if kind in (".txt", ".toml", ".json"):
        text = path.read_text(encoding="utf-8")
        if kind == ".json":
            try:
                content = json.loads(text)
            except json.JSONDecodeError as error:
                raise ModelFormatError(path, f"{error}", "JSON") from error
            content = content.get("landmarks68") if isinstance(content, dict) else content
            return _from_indices(path, np.asarray(content))
        lines = [re.split(r"[;#]", line, maxsplit=1)[0] for line in text.splitlines()]
        pairs = [re.fullmatch(r"\s*(\d+)\s*(?:=|\s)\s*(\d+)\s*", line) for line in lines]
        found = {int(m[1]) - 1: _vertex(int(m[2])) for m in pairs if m and 1 <= int(m[1]) <= 68}
        if found and len(found) == sum(m is not None for m in pairs):
            return found
        return _from_indices(path, np.array(re.findall(r"-?\d+", " ".join(lines)), np.int64))
    if kind == ".npz":
        content = load_npz(path)
    elif kind == ".npy":
        content = load_npy(path)
    elif kind == ".pkl":
        content = load_pickle(path)
    else:
        raise ModelFormatError(path, f"suffix {kind!r}", ".txt, .toml, .json, .npz, .npy or .pkl")
    if not isinstance(content, dict):
        return _from_indices(path, np.asarray(content))
    if "landmarks68" in content:
        return _from_indices(path, np.asarray(content["landmarks68"]))
    return _from_embedding(path, content, faces)


def _from_indices(path: Path, indices: np.ndarray) -> dict[int, _Point]:
    require(
        indices.shape == (68,) and indices.dtype.kind in "iu",
        path,
        f"values of shape {indices.shape} and type {indices.dtype}",
        "68 vertex indices, an embedding, or an eos mapping",
    )
    return {number: _vertex(int(index)) for number, index in enumerate(indices)}


def _from_embedding(path: Path, content: dict, faces: np.ndarray) -> dict[int, _Point]:
    face_key = next((key for key in _FACE_KEYS if key in content), None)
    weight_key = next((key for key in _WEIGHT_KEYS if key in content), None)
    if face_key is None or weight_key is None:
        raise ModelFormatError(
            path, f"keys {sorted(map(str, content))}", "lmk_faces_idx and lmk_b_coords"
        )
    triangle = np.asarray(content[face_key], np.int64)
    weights = np.asarray(content[weight_key], np.float64)
    if weights.ndim == 3:  # a leading batch axis, or one row per head turn: the first is frontal
        triangle, weights = triangle.reshape(len(weights), -1)[0], weights[0]
    triangle = triangle.ravel()
    first = {68: 0, 51: 17, 17: 0}.get(len(triangle))
    if first is None or weights.shape != (len(triangle), 3):
        raise ModelFormatError(
            path, f"{triangle.shape} triangles, weights {weights.shape}", "68, 51 or 17 points"
        )
    require(
        0 <= triangle.min() and triangle.max() < len(faces),
        path,
        f"triangles {triangle.min()} to {triangle.max()}",
        f"0 to {len(faces) - 1}",
    )
    corners = np.asarray(faces)[triangle]
    return {
        first + i: ((int(a), int(b), int(c)), (float(w[0]), float(w[1]), float(w[2])))
        for i, ((a, b, c), w) in enumerate(zip(corners, weights, strict=True))
    }


def _contour_points(path: Path) -> dict[int, _Point]:
    """Points 1-8 and 17-10 of the jaw, spread evenly over eos's contour lists (top to chin)."""
    try:
        contour = json.loads(path.read_text(encoding="utf-8"))["model_contour"]
        right, left = contour["right_contour"], contour["left_contour"]
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise ModelFormatError(path, f"{error}", "model_contour with right and left") from error
    points = {}
    for step in range(8):
        points[step] = _vertex(right[round(step * (len(right) - 1) / 8)])
        points[16 - step] = _vertex(left[round(step * (len(left) - 1) / 8)])
    return points


def _fill_mouth_corners(points: dict[int, _Point]) -> None:
    """Points 61 and 65, which eos's mappings leave out, a fifth of the way in from the corners."""
    for number, (outer, above, below) in {60: (48, 61, 67), 64: (54, 63, 65)}.items():
        near = [points.get(i) for i in (outer, above, below)]
        if number not in points and all(p is not None and p[1] == (1.0, 0.0, 0.0) for p in near):
            a, b, c = (p[0][0] for p in near if p is not None)
            points[number] = (a, b, c), (0.8, 0.1, 0.1)
