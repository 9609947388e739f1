"""A folder of photos over the workers of a dask.distributed scheduler, one task a photo.

The workers see photos, results and models under the same paths as the process that asks, so these
lie on a file system that all share; what they keep between runs is each machine's own cache, or
one that is shared too.
"""

import dataclasses
import functools
import importlib
import os
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from threading import Lock
from typing import Any, Unpack

from jaxface.pipeline.folder import (
    FolderEntry,
    Journey,
    PhotoWork,
    attempt,
    folders_of,
    reason,
)
from jaxface.pipeline.options import DigitizeOptions, DigitizeOverrides
from jaxface.run.compile_cache import enable_compilation_cache

EXTRA = "cluster"
ANSWER_WITHIN = 30
"""seconds in which a scheduler has to answer"""

_one_at_a_time = Lock()


def digitize_on_cluster(
    photos: Sequence[Path],
    out: str | os.PathLike[str],
    scheduler: str,
    options: DigitizeOptions | None = None,
    **overrides: Unpack[DigitizeOverrides],
) -> Iterator[FolderEntry]:
    """As `digitize_folder`, over the workers of a scheduler; entries come as photos are done.

    A worker does one photo at a time, whatever its number of threads. Photos that are done, or that
    another process is at, are passed over as ever; when this process ends, those that no worker has
    begun are withdrawn.

    Args:
        photos: files with different stems.
        out: folder.
        scheduler: its address, as ``tcp://host:8786``, or the ``.json`` file it has written.
        options: the settings, as of ``digitize``; the model by its name or file.
        overrides: single settings, by their names in ``options``.

    Raises:
        ModuleNotFoundError: `distributed` is not installed.
        ValueError: as `digitize_folder`, or no scheduler answers.
        FileNotFoundError: as `digitize_folder`, or there is no such ``.json``.
    """
    _distributed()
    asked = dataclasses.replace(options or DigitizeOptions(), **overrides)
    work = Journey(asked).elsewhere().prepared()
    yield from run_on_cluster(photos, out, scheduler, work)


def run_on_cluster(
    photos: Sequence[Path], out: str | os.PathLike[str], scheduler: str, work: PhotoWork
) -> Iterator[FolderEntry]:
    """As `digitize_on_cluster`, with any work whose code the workers can import."""
    distributed = _distributed()
    folders = folders_of(photos, Path(out).absolute())
    with _client(distributed, scheduler) as client:
        if photos and not client.scheduler_info()["workers"]:
            warnings.warn(f"the scheduler at {scheduler!r} has no worker yet", stacklevel=2)
        photo_of = {
            client.submit(digitize_photo, work, photo.absolute(), folder, pure=False): photo
            for photo, folder in zip(photos, folders, strict=True)
        }
        try:
            for future in distributed.as_completed(photo_of, loop=client.loop):
                photo = photo_of[future]
                folder = Path(out) / photo.stem
                if future.status == "finished":
                    yield future.result()._replace(photo=photo, out=folder)
                else:
                    error = future.exception() if future.status == "error" else None
                    told = reason(error) if error is not None else f"the task is {future.status}"
                    yield FolderEntry(photo, folder, None, told, "failed")
        finally:
            client.cancel(list(photo_of))


def digitize_photo(work: PhotoWork, photo: Path, out: Path) -> FolderEntry:
    """On a worker: the work of one photo; the fit stays here, only its files count."""
    _keep_programs()
    with _one_at_a_time:
        return attempt(work, photo, out)._replace(fitted=None)


@functools.cache
def _keep_programs() -> None:
    enable_compilation_cache()


def _distributed() -> Any:
    try:
        return importlib.import_module("distributed")
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"a scheduler needs dask.distributed, which is not there ({error}): "
            f"pip install 'jaxface[{EXTRA}]'"
        ) from error


def _client(distributed: Any, scheduler: str) -> Any:
    named = {"address": scheduler}
    if scheduler.endswith(".json"):
        if not Path(scheduler).is_file():
            raise FileNotFoundError(f"there is no file of a scheduler {scheduler}")
        named = {"scheduler_file": scheduler}
    try:
        return distributed.Client(**named, timeout=ANSWER_WITHIN, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ValueError(f"no scheduler answers at {scheduler!r}: {error}") from error
