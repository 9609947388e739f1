"""A reader of cereal's portable parts as eos writes them: little-endian binary, no tags.

cereal's ``BinaryOutputArchive`` writes values one after another without names or types, so the
layout below is eos's own (patrikhuber/eos, Apache-2.0; the classes `PcaModel`, `Blendshape` and
`MorphableModel` at class version 4, checked against files that eos 1.5 writes).
"""

import struct
from pathlib import Path

import numpy as np

from jaxface.io.face_models.assemble import ModelFormatError


class CerealReader:
    """Walks through an archive; every read checks that the file is long enough."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._data = self.path.read_bytes()
        self._at = 0

    def _take(self, count: int, what: str) -> bytes:
        left = len(self._data) - self._at
        if count > left:
            raise ModelFormatError(
                self.path,
                f"{left} bytes left of {len(self._data)} at {what}",
                f"{count} bytes: the file is cut short or no eos model",
            )
        self._at += count
        return self._data[self._at - count : self._at]

    def number(self, code: str, what: str) -> int:
        """One little-endian number of a `struct` code."""
        return struct.unpack("<" + code, self._take(struct.calcsize("<" + code), what))[0]

    def matrix(self, what: str) -> np.ndarray:
        """``Eigen::Matrix<float>``: int32 rows, int32 columns, float32 values column by column."""
        rows, columns = self.number("i", f"rows of {what}"), self.number("i", f"columns of {what}")
        if rows < 0 or columns < 0:
            raise ModelFormatError(self.path, f"{what} of {rows} x {columns}", "a matrix's size")
        values = np.frombuffer(self._take(4 * rows * columns, what), "<f4")
        return values.reshape(columns, rows).T

    def arrays(self, dtype: str, width: int, what: str) -> np.ndarray:
        """``std::vector<std::array<T, width>>``: uint64 count, then the values."""
        count = self.number("Q", f"count of {what}")
        itemsize = np.dtype(dtype).itemsize
        return np.frombuffer(self._take(count * width * itemsize, what), dtype).reshape(-1, width)

    def text(self, what: str) -> str:
        """``std::string``: uint64 length, then the bytes."""
        return self._take(self.number("Q", f"length of {what}"), what).decode("utf-8", "replace")

    def has_value(self, what: str) -> bool:
        """``std::optional``: a byte that is 1 where it is empty."""
        flag = self.number("B", f"presence of {what}")
        if flag not in (0, 1):
            raise ModelFormatError(self.path, f"presence byte {flag} of {what}", "0 or 1")
        return flag == 0

    def finish(self) -> None:
        """Check that nothing is left over.

        Raises:
            ModelFormatError: bytes follow the last value.
        """
        left = len(self._data) - self._at
        if left:
            raise ModelFormatError(
                self.path, f"{left} bytes after the last value", "the end of the archive"
            )
