"""Arrays of many textures on disk: one memory-mapped file a texture, whole or absent.

A file starts with a header of 64 bytes: ``jaxface-grams1``, two newlines, the key (32 bytes) and
the checksum of the rest (CRC-32, 8 hexadecimal digits). The arrays follow, each at a multiple of
64 bytes, little-endian. The key is a digest of everything the arrays depend on.
"""

import math
import os
import zlib
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from jaxface.io.atomic import atomic_path

_MAGIC = b"jaxface-grams1\n\n"
_HEADER = 64
_ALIGNMENT = 64


class GramCache:
    """A folder of files of one format.

    Attributes:
        path: the folder.
        shapes: of each array of a texture.
        types: NumPy's names of their types.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        shapes: Mapping[str, tuple[int, ...]],
        types: Mapping[str, str],
    ) -> None:
        self.path, self.shapes, self.types = Path(path), dict(shapes), dict(types)
        self._offsets: dict[str, int] = {}
        end = _HEADER
        for name, shape in self.shapes.items():
            self._offsets[name] = end
            size = math.prod(shape) * np.dtype(self.types[name]).itemsize
            end += -(-size // _ALIGNMENT) * _ALIGNMENT
        self.bytes_per_texture = end

    def file(self, key: str) -> Path:
        """Where a texture's arrays lie, or would lie."""
        return self.path / f"{key}.grams"

    def write(self, key: str, arrays: Mapping[str, np.ndarray]) -> None:
        """Write a texture's arrays, in place of those that may lie there.

        Raises:
            ValueError: an array is missing, or of another shape.
        """
        content = np.zeros(self.bytes_per_texture - _HEADER, np.uint8)
        for name, shape in self.shapes.items():
            if name not in arrays or arrays[name].shape != shape:
                found = arrays[name].shape if name in arrays else "absent"
                raise ValueError(f"array {name!r} is {found}; needed is the shape {shape}")
            data = np.ascontiguousarray(arrays[name], self.types[name]).reshape(-1).view(np.uint8)
            start = self._offsets[name] - _HEADER
            content[start : start + data.size] = data
        header = _MAGIC + key.encode().ljust(32) + f"{zlib.crc32(content.data):08x}".encode()
        with atomic_path(self.file(key)) as temporary, open(temporary, "wb") as stream:
            stream.write(header.ljust(_HEADER))
            stream.write(content.data)

    def is_whole(self, key: str, thorough: bool = True) -> bool:
        """Whether a texture's file is there and undamaged; thorough: by its checksum too."""
        try:
            if self.file(key).stat().st_size != self.bytes_per_texture:
                return False
            with open(self.file(key), "rb") as stream:
                header = stream.read(_HEADER)
        except OSError:
            return False
        if header[:48] != _MAGIC + key.encode().ljust(32):
            return False
        if not thorough:
            return True
        content = np.memmap(self.file(key), np.uint8, "r", offset=_HEADER)
        return header[48:56] == f"{zlib.crc32(content.data):08x}".encode()

    def read(self, key: str) -> dict[str, np.ndarray]:
        """A texture's arrays, memory-mapped: read from disk where they are used.

        Raises:
            ValueError: the file is absent, or cut off, or of another key.
        """
        if not self.is_whole(key, thorough=False):
            raise ValueError(f"{self.file(key)} is absent or damaged; precompute it again")
        content = np.memmap(self.file(key), np.uint8, "r")
        found = {}
        for name, shape in self.shapes.items():
            kind, start = np.dtype(self.types[name]), self._offsets[name]
            part = content[start : start + math.prod(shape) * kind.itemsize]
            found[name] = np.asarray(part).view(kind).reshape(shape)
        return found

    def prune(self, keys: Collection[str], maximum_bytes: int) -> None:
        """Remove the oldest files of other keys until the folder holds no more than allowed."""
        held = []
        for path in self.path.glob("*.grams"):
            try:
                status = path.stat()
            except OSError:
                continue  # another process has removed it
            held.append((status.st_mtime, status.st_size, path))
        total = sum(size for _, size, _ in held)
        for _, size, path in sorted(held):
            if total > maximum_bytes and path.stem not in keys:
                path.unlink(missing_ok=True)
                total -= size
