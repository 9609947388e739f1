"""Work in progress kept on disk, so that a run that was killed goes on where it stopped.

A checkpoint is a folder of ``.npz`` files, one to a named piece of work: arrays, a JSON record and
the key, which is a digest of everything the work depends on. One policy holds for all of them:

- A file of another key is of another job. It counts as absent, silently, and is replaced when the
  piece of that name is written.
- A file that is no whole checkpoint (cut off, damaged, foreign, unreadable) counts as absent too,
  and a warning names it. The work is done again; a kept file can cost time, never a wrong result.
"""

import json
import os
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxface.io.atomic import atomic_path

_HEADER = "checkpoint"
_ARRAY = "array."
_NAME = re.compile(r"\w[\w.-]*")


class Kept(NamedTuple):
    """One piece of work as it was written.

    Attributes:
        arrays: by name.
        record: JSON; tuples come back as lists.
    """

    arrays: dict[str, np.ndarray]
    record: dict[str, Any]


class Checkpoint:
    """The pieces of one job.

    Attributes:
        folder: where the files lie, one ``<name>.npz`` for each piece; it belongs to the job.
        key: a `digest` of everything that the pieces depend on: inputs, settings, code.
    """

    def __init__(self, folder: str | os.PathLike[str], key: str) -> None:
        self.folder, self.key = Path(folder), key

    def file(self, name: str) -> Path:
        """Where a piece lies, or would lie.

        Raises:
            ValueError: the name is not made of letters, digits, ``_``, ``-`` and dots.
        """
        if not _NAME.fullmatch(name):
            raise ValueError(f"name is {name!r}; needed are letters, digits, '_', '-' and '.'")
        return self.folder / f"{name}.npz"

    def read(self, name: str) -> Kept | None:
        """A finished piece; None where there is none of this key.

        A damaged or foreign file is None too, and is warned of.

        Raises:
            ValueError: as for `file`.
        """
        file = self.file(name)
        try:
            with open(file, "rb") as stream, np.load(stream, allow_pickle=False) as stored:
                header = json.loads(str(stored[_HEADER]))
                if header["key"] != self.key:
                    return None
                arrays = {array: stored[_ARRAY + array] for array in header["arrays"]}
                record = dict(header["record"])
        except FileNotFoundError:
            return None
        except Exception as error:  # a damaged archive fails in whatever way its bytes make it
            warnings.warn(
                f"{file} is no whole checkpoint ({error}); what it kept is made again", stacklevel=2
            )
            return None
        return Kept(arrays, record)

    def write(
        self,
        name: str,
        arrays: Mapping[str, np.ndarray],
        record: Mapping[str, Any] | None = None,
    ) -> None:
        """Keep a piece, whole or not at all, in place of what may lie there.

        Args:
            name: of the piece.
            arrays: by name, of numbers, truth values or text.
            record: JSON-able facts.

        Raises:
            ValueError: as for `file`, or an array holds Python objects.
            TypeError: the record cannot be written as JSON.
            OSError: the file cannot be written.
        """
        values = {array: np.asarray(value) for array, value in arrays.items()}
        for array, value in values.items():
            if value.dtype.kind not in "biufcSU":
                raise ValueError(
                    f"array {array!r} is of type {value.dtype}; needed are numbers or text"
                )
        header = {"key": self.key, "arrays": list(values), "record": dict(record or {})}
        entries: dict[str, Any] = {_ARRAY + array: value for array, value in values.items()}
        entries[_HEADER] = np.array(json.dumps(header))
        with atomic_path(self.file(name)) as temporary, open(temporary, "wb") as stream:
            np.savez(stream, **entries)

    def clear(self) -> None:
        """The job is done: remove its pieces, those of other keys too, and the empty folder."""
        if not self.folder.is_dir():
            return
        for file in self.folder.glob("*.npz"):
            file.unlink(missing_ok=True)
        try:
            self.folder.rmdir()
        except OSError:
            pass  # something else lies there, which is not ours to remove
