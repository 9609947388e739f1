"""A folder of albedo textures of many subjects in one model's UVs.

``database.json`` names the database, its licence, the UV layout and its subjects; each subject has
``textures/NAME.png``, 8-bit sRGB-encoded albedo, its colours continued outside the UV islands::

    {"schema": "jaxface-textures/1", "name": ..., "licence": ..., "credits": [...],
     "uv": {"model": ..., "digest": ...}, "resolution": 1024,
     "subjects": [{"name": ..., "file": ..., "licence": ..., "attributes": {...}}, ...]}

Every file is written whole or not at all, a texture before the entry that names it, so an
interrupted run leaves a valid database that a later run completes. Several processes may add to one
database: an entry is added to those that the file has at that moment, under a lock.
"""

import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from PIL import Image

from jaxface._types import Float
from jaxface.imaging.colour import srgb_to_linear
from jaxface.io.atomic import atomic_path
from jaxface.io.cache_folder import cache_dir
from jaxface.io.file_lock import exclusive
from jaxface.io.formats.exr import srgb_encoded
from jaxface.io.formats.image import write_png
from jaxface.models.maps import uv_digest
from jaxface.models.morphable import MorphableModel

SCHEMA = "jaxface-textures/1"
INDEX = "database.json"
LOCK = ".lock"
"""held while the index is read and written again"""

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


@dataclass(frozen=True)
class Subject:
    """One texture of a database."""

    name: str
    file: str
    """relative to the database's folder"""
    licence: str
    attributes: Mapping[str, Any] = field(default_factory=dict)
    """what is known of the subject, as plain JSON values"""


class TextureDatabase:
    """Albedo textures on disk, read one at a time.

    Attributes:
        path: the folder.
        name: what the database is called.
        licence: of the whole, one line.
        credits: lines to print with results.
        model: name of the model whose UVs the textures are in.
        digest: `uv_digest` of those UVs.
        resolution: texels along a side of every texture.
    """

    def __init__(self, path: str | os.PathLike[str], model: MorphableModel | None = None):
        """Open a database.

        Args:
            path: the folder, its ``database.json``, or the name of one of `cached_databases`.
            model: where given, the model whose UVs the textures must be in.

        Raises:
            FileNotFoundError: there is no such folder or name, or no ``database.json`` in it.
            ValueError: the file is not of the format, or the UVs are of another model.
        """
        folder = _folder_of(path)
        index = folder / INDEX
        try:
            content = json.loads(index.read_text(encoding="utf-8"))
        except (json.JSONDecodeError, UnicodeDecodeError) as error:
            raise ValueError(f"{index} is not valid JSON: {error}") from error
        if not isinstance(content, dict) or content.get("schema") != SCHEMA:
            found = content.get("schema") if isinstance(content, dict) else type(content).__name__
            raise ValueError(f"{index} has schema {found!r}; this version reads {SCHEMA!r}")
        try:
            self.path = folder
            self.name = str(content["name"])
            self.licence = str(content["licence"])
            self.credits = tuple(str(line) for line in content["credits"])
            self.model = str(content["uv"]["model"])
            self.digest = str(content["uv"]["digest"])
            self.resolution = int(content["resolution"])
            subjects = [Subject(**entry) for entry in content["subjects"]]
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{index} lacks or misspells an entry: {error!r}") from error
        for subject in subjects:
            check_name(subject.name)
            if Path(subject.file).is_absolute() or ".." in Path(subject.file).parts:
                raise ValueError(
                    f"{index}: subject {subject.name!r} lies outside the folder: {subject.file!r}"
                )
        self._subjects = {subject.name: subject for subject in subjects}
        if len(self._subjects) != len(subjects):
            raise ValueError(f"{index} names a subject twice")
        if model is not None and uv_digest(model) != self.digest:
            raise ValueError(
                f"database {self.name!r} is in the UVs of model {self.model!r} ({self.digest}); "
                f"model {model.name!r} has others ({uv_digest(model)})"
            )

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        model: MorphableModel,
        resolution: int,
        *,
        name: str,
        licence: str,
        credits: Sequence[str] = (),
    ) -> "TextureDatabase":
        """Begin a database, or go on with the one that lies there, adding to its credits.

        Raises:
            ValueError: a database of other UVs or another resolution lies there, or the
                resolution is not 16 to 16384.
        """
        if not 16 <= resolution <= 16384:
            raise ValueError(f"resolution is {resolution}; it needs 16 to 16384 texels")
        made = cls.__new__(cls)
        made.path, made.name, made.licence = Path(path), name, licence
        made.credits, made.resolution = tuple(credits), resolution
        made.model, made.digest = model.name, uv_digest(model)
        made._subjects = {}
        present = made._as_on_disk(model)
        # One that lies there with its credits is opened without a lock: it may be read-only.
        if present is None or set(credits) - set(present.credits):
            with exclusive(made.path / LOCK):
                present = made._as_on_disk(model)
                present = made if present is None else present
                added = [line for line in credits if line not in present.credits]
                present.credits = (*present.credits, *added)
                present._write_index()
        return present

    @property
    def subjects(self) -> tuple[Subject, ...]:
        """The subjects in the order in which they were written."""
        return tuple(self._subjects.values())

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the subjects."""
        return tuple(self._subjects)

    def __len__(self) -> int:
        return len(self._subjects)

    def __contains__(self, name: object) -> bool:
        return name in self._subjects

    def __iter__(self) -> Iterator[Float[np.ndarray, "r r 3"]]:
        """Every subject's `encoded` texture, in order."""
        return (self.encoded(name) for name in self.names)

    def encoded(self, name: str) -> Float[np.ndarray, "r r 3"]:
        """A subject's albedo as stored: sRGB-encoded, 0 to 1, float32.

        Raises:
            KeyError: there is no such subject.
            ValueError: its file is absent, no image, or of another size.
        """
        if name not in self._subjects:
            raise KeyError(f"database {self.name!r} has no subject {name!r}")
        file = self.path / self._subjects[name].file
        try:
            with Image.open(file) as image:
                texture = np.asarray(image.convert("RGB"), np.float32) / 255
        except (OSError, SyntaxError, ValueError) as error:
            raise ValueError(f"texture of {name!r} cannot be read: {error}") from error
        if texture.shape[:2] != (self.resolution, self.resolution):
            raise ValueError(
                f"{file} is {texture.shape[1]}x{texture.shape[0]} texels; the database's are "
                f"{self.resolution}x{self.resolution}"
            )
        return texture

    def albedo(self, name: str) -> Float[np.ndarray, "r r 3"]:
        """A subject's albedo, linear RGB; raises as `encoded`."""
        return np.asarray(srgb_to_linear(jnp.asarray(self.encoded(name))))

    def stamp(self, name: str) -> str:
        """Size and time of change of a subject's file, by which it is taken to be the same."""
        try:
            status = (self.path / self._subjects[name].file).stat()
        except OSError:
            return "absent"
        return f"{status.st_size} {status.st_mtime_ns}"

    def is_whole(self, name: str) -> bool:
        """Whether a subject is listed and its file is an image of the right size."""
        if name not in self._subjects:
            return False
        try:
            with Image.open(self.path / self._subjects[name].file) as image:
                return image.size == (self.resolution, self.resolution)
        except (OSError, SyntaxError):
            return False

    def write_subject(
        self,
        name: str,
        albedo: Float[np.ndarray, "r r 3"],
        *,
        licence: str | None = None,
        attributes: Mapping[str, Any] | None = None,
    ) -> Subject:
        """Add a subject, or replace the one of that name; the texture first, then its entry.

        Args:
            name: letters, digits, ``.``, ``_`` and ``-``.
            albedo: linear RGB, continued outside the UV islands.
            licence: the subject's own, by default the database's.
            attributes: plain JSON values.

        Raises:
            ValueError: a bad name, another shape, or values that are not finite.
        """
        check_name(name)
        texture = np.asarray(albedo, np.float32)
        if texture.shape != (self.resolution, self.resolution, 3):
            raise ValueError(
                f"albedo of {name!r} has shape {texture.shape}; "
                f"({self.resolution}, {self.resolution}, 3) is needed"
            )
        if not np.isfinite(texture).all():
            raise ValueError(f"albedo of {name!r} holds NaN or infinite values")
        subject = Subject(
            name, f"textures/{name}.png", licence or self.licence, dict(attributes or {})
        )
        json.dumps(subject.attributes, allow_nan=False)  # raises before anything is written
        write_png(self.path / subject.file, srgb_encoded(texture))
        with exclusive(self.path / LOCK):
            # With what other processes have written since this one has looked.
            present = self._as_on_disk()
            present = self if present is None else present
            self.credits = present.credits
            self._subjects = {**present._subjects, name: subject}
            self._write_index()
        return subject

    def info(self) -> dict[str, Any]:
        """What the database is, for a listing: names, licences, size on disk (bytes), gaps."""
        files = [self.path / subject.file for subject in self.subjects]
        return {
            "name": self.name,
            "path": str(self.path),
            "licence": self.licence,
            "licences": sorted({subject.licence for subject in self.subjects}),
            "credits": list(self.credits),
            "model": self.model,
            "resolution": self.resolution,
            "subjects": len(self),
            "bytes": sum(file.stat().st_size for file in files if file.is_file()),
            "missing": [s.name for s in self.subjects if not self.is_whole(s.name)],
        }

    def _as_on_disk(self, model: MorphableModel | None = None) -> "TextureDatabase | None":
        """The database that lies in the folder now, which must be of this one's resolution."""
        if not (self.path / INDEX).is_file():
            return None
        present = TextureDatabase(self.path, model)
        if present.resolution != self.resolution:
            raise ValueError(
                f"{self.path} holds textures of {present.resolution} texels, not "
                f"{self.resolution}; choose another folder"
            )
        return present

    def _write_index(self) -> None:
        content = {
            "schema": SCHEMA,
            "name": self.name,
            "licence": self.licence,
            "credits": list(self.credits),
            "uv": {"model": self.model, "digest": self.digest},
            "resolution": self.resolution,
            "subjects": [asdict(subject) for subject in self._subjects.values()],
        }
        with atomic_path(self.path / INDEX) as temporary:
            temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def check_name(name: str) -> None:
    """Raise a ValueError unless the name can be a file's name everywhere."""
    if not _NAME.fullmatch(name):
        raise ValueError(
            f"subject name {name!r}; it needs 1 to 100 letters, digits, '.', '_' or '-', "
            "beginning with a letter or digit"
        )


def databases_dir() -> Path:
    """Folder of the databases that are made on demand."""
    return cache_dir() / "databases"


def cached_databases() -> list[Path]:
    """Databases in `databases_dir`."""
    return sorted(path.parent for path in databases_dir().glob(f"*/{INDEX}"))


def _folder_of(path: str | os.PathLike[str]) -> Path:
    folder = Path(path)
    folder = folder.parent if folder.name == INDEX else folder
    if (folder / INDEX).is_file():
        return folder
    named = databases_dir() / folder
    if len(folder.parts) == 1 and (named / INDEX).is_file():
        return named
    known = ", ".join(cached.name for cached in cached_databases()) or "none"
    raise FileNotFoundError(
        f"{folder} is no texture database: it has no {INDEX}, nor is it the name of one in the "
        f"cache (there: {known})"
    )
