"""A folder of photos in, a folder of results for each out; alone or side by side with others."""

import dataclasses
import os
import re
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, Unpack

from jaxface.io.face_models.model_file import bundled_models
from jaxface.io.feature_weights import NAMES
from jaxface.io.file_lock import claimed
from jaxface.pipeline import _digitize as one
from jaxface.pipeline.databases.usual import OnStep, silent
from jaxface.pipeline.fitting._fit import FittedFace
from jaxface.pipeline.options import DigitizeOptions, DigitizeOverrides
from jaxface.pipeline.photo import in_order
from jaxface.pipeline.texture.folder import WORK_FOLDER

LOCKS = ".locks"
"""folder, among the results, of the locks of the photos that are worked on"""

PATHS = ("model", "landmarks", "mask", "database", "features")
"""options that may be paths"""


class FolderEntry(NamedTuple):
    """What became of one photo of a folder.

    Attributes:
        photo: its path.
        out: the folder of its results.
        fitted: the fit, if it was made now and in this process.
        error: why there is none.
        state: ``written`` now; ``present``, done before; ``taken``, another process is at it; or
            ``failed``.
    """

    photo: Path
    out: Path
    fitted: FittedFace | None
    error: str | None
    state: Literal["written", "present", "taken", "failed"]


class PhotoWork(Protocol):
    """What is done with each photo; it goes to other processes by pickle."""

    def is_done(self, out: Path) -> bool:
        """Whether the results in a photo's folder are complete."""
        ...

    def __call__(self, photo: Path, out: Path, on_step: OnStep) -> FittedFace | None:
        """Write the results, or what of them is missing."""
        ...


def shard_of(photos: Sequence[Path], shard: str) -> list[Path]:
    """The photos of one shard: with ``3/8`` the 3rd, 11th, 19th ... in the order of their names.

    Shards are disjoint and together hold every photo, if all are cut from the same photos.

    Args:
        photos: all photos, in any order.
        shard: ``K/N``, with K from 1 to N.

    Returns:
        The photos of the shard, which may be none.

    Raises:
        ValueError: ``shard`` is no such text, or two of all photos would share a folder.
    """
    matched = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", shard)
    number, count = (int(part) for part in matched.groups()) if matched else (0, 0)
    if not 1 <= number <= count:
        raise ValueError(f"shard is {shard!r}; needed is K/N with K from 1 to N, as 3/8")
    folders_of(photos, ".")
    return sorted(photos, key=in_order)[number - 1 :: count]


def folders_of(photos: Sequence[Path], out: str | os.PathLike[str]) -> list[Path]:
    """The folder of each photo's results, named after it.

    Raises:
        ValueError: two photos would share a folder.
    """
    folders = [Path(out) / photo.stem for photo in photos]
    if len({os.path.normcase(folder) for folder in folders}) < len(folders):
        raise ValueError("photos whose names differ only in the suffix would share a folder")
    return folders


def digitize_folder(
    photos: Sequence[Path],
    out: str | os.PathLike[str],
    options: DigitizeOptions | None = None,
    *,
    on_start: Callable[[Path], None] = lambda photo: None,
    on_step: OnStep = silent,
    **overrides: Unpack[DigitizeOverrides],
) -> Iterator[FolderEntry]:
    """Digitize photos one after the other into folders of ``out`` named after them.

    Photos whose folder is complete are passed over, so a killed run goes on where it stopped; one
    that cannot be fitted is told and does not end the run. All share one compiled program.

    Several processes may work into one ``out``: a photo that another one is at is passed over too,
    and looked at once more in the end.

    Args:
        photos: files with different stems; of many processes each may be given its `shard_of` them.
        out: folder.
        options: the settings, as of ``digitize``.
        on_start: called before each photo that is not done yet.
        on_step: told of the steps of each completion.
        overrides: single settings, by their names in ``options``.

    Raises:
        ValueError: two photos would share a folder, or no completion can be as it is asked for.
        FileNotFoundError: there is no such model, database or file of weights.
    """
    asked = dataclasses.replace(options or DigitizeOptions(), **overrides)
    yield from run_folder(photos, out, Journey(asked).prepared(), on_start, on_step)


def run_folder(
    photos: Sequence[Path],
    out: str | os.PathLike[str],
    work: PhotoWork,
    on_start: Callable[[Path], None] = lambda photo: None,
    on_step: OnStep = silent,
) -> Iterator[FolderEntry]:
    """As `digitize_folder`, with any work."""
    todo = list(zip(photos, folders_of(photos, out), strict=True))
    for last in (False, True):
        taken = []
        for photo, folder in todo:
            if not work.is_done(folder):
                on_start(photo)
            entry = attempt(work, photo, folder, on_step)
            if entry.state == "taken" and not last:
                taken.append((photo, folder))
            else:
                yield entry
        todo = taken


def attempt(work: PhotoWork, photo: Path, out: Path, on_step: OnStep = silent) -> FolderEntry:
    """Do the work of one photo, if nobody has done it or is at it; its failure is an answer too.

    Raises:
        OSError: the folder of the locks, beside ``out``, cannot be written.
    """
    if work.is_done(out):
        return FolderEntry(photo, out, None, None, "present")
    with claimed(out.parent / LOCKS / f"{out.name}.lock") as free:
        if not free:
            return FolderEntry(photo, out, None, None, "taken")
        if work.is_done(out):  # by another process, since the first look
            return FolderEntry(photo, out, None, None, "present")
        try:
            return FolderEntry(photo, out, work(photo, out, on_step), None, "written")
        except Exception as error:  # the next photo is none the worse for it
            return FolderEntry(photo, out, None, reason(error), "failed")


def reason(error: BaseException) -> str:
    """One line that says why a photo failed, with the place if it is no fault of the photo's."""
    if isinstance(error, ValueError | FileNotFoundError):
        return str(error)
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {error}{place}"


class Journey:
    """The whole journey of a photo with given settings; all that is known of these is here.

    Attributes:
        options: as ``digitize`` takes them.
    """

    def __init__(self, options: DigitizeOptions) -> None:
        self.options = options
        self._opened: one.Opened | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {"options": self.options, "_opened": None}  # what is loaded stays where it is

    def prepared(self) -> "Journey":
        """Load the model and check the settings, which the first photo does otherwise.

        Raises:
            ValueError: no completion can be as it is asked for.
            FileNotFoundError: there is no such model, database or file of weights.
        """
        self._open()
        return self

    def elsewhere(self) -> "Journey":
        """The same for a process with another working folder.

        Raises:
            ValueError: the model is in memory alone.
        """
        model = self.options.model
        if not isinstance(model, str | os.PathLike):
            raise ValueError(
                f"model is a {type(model).__name__} in memory; for other machines give its name, "
                "or the path of a file (save_model writes one)"
            )
        return Journey(_absolute(self.options))

    def is_done(self, out: Path) -> bool:
        """Whether the report is there, and the complete albedo where one is asked for."""
        if not (out / "report.json").is_file():
            return False
        complete = (out / "albedo.png").is_file() and not (out / WORK_FOLDER).exists()
        return complete or self._open().completion is None

    def __call__(self, photo: Path, out: Path, on_step: OnStep) -> FittedFace | None:
        """Fit and complete, or complete what is fitted; raises as ``digitize``."""
        if not (out / "report.json").is_file():
            return one.digitize_opened(photo, out, self._open(), on_step=on_step)
        one.complete_opened(out, self._open(), on_step=on_step)
        return None

    def _open(self) -> one.Opened:
        if self._opened is None:
            self._opened = one.open_digitize(self.options)
        return self._opened


def _absolute(options: DigitizeOptions) -> DigitizeOptions:
    """Settings with those that are paths of something from the root on; names stay names."""
    names, found = {*NAMES, *bundled_models()}, {}
    for key in PATHS:
        value = getattr(options, key)
        if value is not None and str(value) not in names and Path(value).exists():
            found[key] = str(Path(value).absolute())
    return dataclasses.replace(options, **found)
