"""Wavefront OBJ meshes, read and written. UV origin bottom-left, as in OBJ itself."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxface._types import Float, Int
from jaxface.io.atomic import atomic_path
from jaxface.io.formats.mesh_checks import check_indices, check_table


@dataclass(frozen=True)
class ObjMesh:
    """A polygon mesh as an OBJ file holds it; polygons have a 4th corner of -1 if triangles."""

    vertices: Float[np.ndarray, "n 3"]
    """in the file's units"""
    polygons: Int[np.ndarray, "q 4"]
    """quads and triangles, counter-clockwise; larger polygons are cut into a fan of triangles"""
    uv: Float[np.ndarray, "m 2"] | None
    uv_polygons: Int[np.ndarray, "q 4"] | None
    """each polygon's corners in ``uv``"""
    normals: Float[np.ndarray, "l 3"] | None
    material: Int[np.ndarray, "q"]
    """index into ``materials`` of each polygon"""
    materials: tuple[str, ...]
    """names in order of appearance; '' where no material is set"""
    texture: Path | None
    """the image of the first ``map_Kd`` of the material file, if it names one"""

    @property
    def faces(self) -> Int[np.ndarray, "f 3"]:
        """Triangles: a quad ``a b c d`` is cut into ``a b c`` and ``a c d``."""
        return triangles(self.polygons)

    @property
    def uv_faces(self) -> Int[np.ndarray, "f 3"] | None:
        """The triangles' corners in ``uv``."""
        if self.uv_polygons is None:
            return None
        return triangles(self.uv_polygons, self.polygons[:, 3] >= 0)


def triangles(
    polygons: Int[np.ndarray, "q 4"], is_quad: np.ndarray | None = None
) -> Int[np.ndarray, "f 3"]:
    """Cut quads ``a b c d`` into ``a b c`` and ``a c d``, in place; 4th index -1: a triangle."""
    if is_quad is None:
        is_quad = polygons[:, 3] >= 0
    pairs = np.stack([polygons[:, [0, 1, 2]], polygons[:, [0, 2, 3]]], axis=1)
    keep = np.stack([np.ones(len(polygons), bool), is_quad], axis=1)
    return np.ascontiguousarray(pairs[keep])


def read_obj(path: str | Path) -> ObjMesh:
    """Read vertices, polygons, texture coordinates, normals and material names.

    Negative (relative) indices, vertex colours (ignored), statements over several lines, and
    groups are understood; curves, points and lines are skipped.

    Raises:
        ValueError: no vertices, a bad number or index; the message names the file and the line.
        FileNotFoundError: there is no such file.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except IsADirectoryError as error:
        raise ValueError(f"{path}: a folder; needed an OBJ file") from error
    parser = _Parser(path)
    pending = ""
    for number, line in enumerate(text.splitlines(), start=1):
        if line.endswith("\\"):
            pending += line[:-1] + " "
            continue
        parser.line(number, pending + line)
        pending = ""
    return parser.finish()


def read_obj_vertices(path: str | Path, count: int) -> Float[np.ndarray, "n 3"]:
    """Only the vertices, fast: for one of many meshes that share a topology.

    Raises:
        ValueError: not ``count`` vertices of three finite numbers; the message names the file.
        FileNotFoundError: there is no such file.
    """
    lines = [line[2:] for line in Path(path).read_bytes().splitlines() if line.startswith(b"v ")]
    try:
        vertices = np.array([line.split()[:3] for line in lines], dtype=np.float64)
    except ValueError as error:
        raise ValueError(f"{path}: a vertex line is not three numbers ({error})") from error
    if vertices.shape != (count, 3) or not np.isfinite(vertices).all():
        raise ValueError(
            f"{path}: {len(lines)} vertices; needed {count} of three finite numbers, in the "
            "topology of the neutral mesh"
        )
    return vertices


class _Parser:
    def __init__(self, path: Path) -> None:
        self.path = path
        self.vertices: list[list[float]] = []
        self.uv: list[list[float]] = []
        self.normals: list[list[float]] = []
        self.corners: list[list[tuple[int, int]]] = []
        self.material: list[int] = []
        self.materials: dict[str, int] = {}
        self.current = ""
        self.libraries: list[str] = []

    def fail(self, number: int, what: str) -> ValueError:
        return ValueError(f"{self.path}, line {number}: {what}")

    def line(self, number: int, line: str) -> None:
        key, *values = line.split("#", 1)[0].split() or [""]
        if key == "v":
            self.vertices.append(self.floats(number, line, values, 3))
        elif key == "vt":
            self.uv.append(self.floats(number, line, [*values, "0"], 2))
        elif key == "vn":
            self.normals.append(self.floats(number, line, values, 3))
        elif key == "f":
            self.face(number, values)
        elif key == "usemtl":
            self.current = " ".join(values)
        elif key == "mtllib":
            self.libraries.append(" ".join(values))

    def floats(self, number: int, line: str, values: list[str], count: int) -> list[float]:
        try:
            found = [float(value) for value in values[:count]]
        except ValueError:
            found = []
        if len(found) < count or not np.isfinite(found).all():
            raise self.fail(number, f"{line.strip()!r} has not {count} finite numbers")
        return found

    def face(self, number: int, values: list[str]) -> None:
        corners = [self.corner(number, value) for value in values]
        if len(corners) < 3:
            raise self.fail(number, f"a face with {len(corners)} corners; needed at least 3")
        polygons = [corners]
        if len(corners) > 4:
            polygons = [
                [corners[0], corners[i], corners[i + 1]] for i in range(1, len(corners) - 1)
            ]
        index = self.materials.setdefault(self.current, len(self.materials))
        for polygon in polygons:
            self.corners.append(polygon)
            self.material.append(index)

    def corner(self, number: int, text: str) -> tuple[int, int]:
        parts = text.split("/")
        try:
            vertex = int(parts[0])
            texture = int(parts[1]) if len(parts) > 1 and parts[1] else 0
        except ValueError:
            raise self.fail(number, f"{text!r} is no corner of a face") from None
        vertex = vertex + len(self.vertices) if vertex < 0 else vertex - 1
        if texture:
            texture = texture + len(self.uv) if texture < 0 else texture - 1
        else:
            texture = -1
        # Files may name a vertex before it is defined, so only the sign is checked here.
        if vertex < 0 or (len(parts) > 1 and parts[1] and texture < 0):
            raise self.fail(number, f"index {text!r} is out of range; OBJ counts from 1")
        return vertex, texture

    def finish(self) -> ObjMesh:
        if not self.vertices:
            raise ValueError(f"{self.path}: no vertices ('v' lines); needed an OBJ mesh")
        vertices = np.array(self.vertices)
        table = np.full((len(self.corners), 4, 2), -1, np.int32)
        for row, polygon in zip(table, self.corners, strict=True):
            row[: len(polygon)] = polygon
        polygons, uv_polygons = table[..., 0], table[..., 1]
        for what, indices, limit in (
            ("vertex", polygons, len(vertices)),
            ("texture coordinate", uv_polygons, len(self.uv)),
        ):
            if indices.size and indices.max() >= limit:
                raise ValueError(
                    f"{self.path}: a face names {what} {indices.max() + 1} of only {limit}"
                )
        textured = bool(self.uv) and bool(np.any(uv_polygons >= 0))
        if textured and np.any((uv_polygons < 0) & (polygons >= 0)):
            raise ValueError(f"{self.path}: some corners have texture coordinates, others none")
        return ObjMesh(
            vertices=vertices,
            polygons=polygons,
            uv=np.array(self.uv) if textured else None,
            uv_polygons=uv_polygons if textured else None,
            normals=np.array(self.normals) if self.normals else None,
            material=np.array(self.material, np.int32),
            materials=tuple(self.materials),
            texture=self.texture(),
        )

    def texture(self) -> Path | None:
        for library in self.libraries:
            file = self.path.parent / library
            if file.is_file():
                for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
                    words = line.split()
                    if len(words) > 1 and words[0] == "map_Kd":
                        return file.parent / line.split(None, 1)[1].strip()
        return None


def write_obj(
    path: str | Path,
    vertices: Float[np.ndarray, "n 3"],
    polygons: Int[np.ndarray, "q c"],
    *,
    uv: Float[np.ndarray, "m 2"] | None = None,
    uv_polygons: Int[np.ndarray, "q c"] | None = None,
    normals: Float[np.ndarray, "n 3"] | None = None,
    texture: str | Path | None = None,
    comment: str = "",
) -> None:
    """Write a mesh, and beside it an ``.mtl`` of the same name if there is a texture.

    Args:
        path: the ``.obj``; written whole or not at all.
        vertices: in the units the reader shall see (mm in this package).
        polygons: triangles (q, 3), or quads (q, 4) whose 4th index may be -1.
        uv: texture coordinates, origin bottom-left.
        uv_polygons: the polygons' corners in ``uv``; those of ``polygons`` by default.
        normals: one a vertex.
        texture: image for ``map_Kd``, named relative to the OBJ's folder where it lies below it.
        comment: lines for the head of the file, such as the licence of the data.

    Raises:
        ValueError: shapes disagree, an index is out of range, or a value is not finite.
    """
    path = Path(path)
    vertices = check_table("vertices", vertices, 3)
    polygons = check_indices("polygons", polygons, len(vertices), (3, 4))
    tables = [polygons]
    if uv is not None:
        uv = check_table("uv", uv, 2)
        corners = polygons if uv_polygons is None else uv_polygons
        tables.append(check_indices("uv_polygons", corners, len(uv), (3, 4), like=polygons))
    if normals is not None:
        normals = check_table("normals", normals, 3, len(vertices))
    lines = [f"# {line}".rstrip() for line in comment.splitlines()]
    if texture is not None:
        lines += [f"mtllib {path.stem}.mtl"]
    lines += [f"v {x:.6g} {y:.6g} {z:.6g}" for x, y, z in vertices]
    if uv is not None:
        lines += [f"vt {u:.7g} {v:.7g}" for u, v in uv]
    if normals is not None:
        lines += [f"vn {x:.5g} {y:.5g} {z:.5g}" for x, y, z in normals]
    if texture is not None:
        lines += ["usemtl skin"]
    lines += _face_lines(tables, normals is not None)
    if texture is not None:
        name = os.path.relpath(Path(texture).resolve(), path.resolve().parent)
        name = Path(name).as_posix() if not name.startswith("..") else str(Path(texture).resolve())
        material = f"newmtl skin\nKa 0 0 0\nKd 1 1 1\nKs 0.04 0.04 0.04\nillum 2\nmap_Kd {name}\n"
        with atomic_path(path.with_suffix(".mtl")) as temporary:
            temporary.write_text(material, encoding="utf-8")
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _face_lines(tables: list[np.ndarray], with_normals: bool) -> list[str]:
    lines = []
    for corners in zip(*(table.tolist() for table in tables), strict=True):
        words = []
        for column in zip(*corners, strict=True):
            if column[0] < 0:
                continue
            vertex = column[0] + 1
            word = str(vertex) if len(column) == 1 else f"{vertex}/{column[1] + 1}"
            if with_normals:
                word += f"/{vertex}" if len(column) == 2 else f"//{vertex}"
            words.append(word)
        lines.append("f " + " ".join(words))
    return lines
