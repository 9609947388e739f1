"""Locks by files, for processes that share a folder, on one machine or on several.

The lock is the operating system's and ends with the process that holds it, however that ends, so
none is left behind by a killed run. Where a file system has no such locks, `filelock` says so and
takes the file itself for the mark; then one that a killed run on another machine has left must be
deleted by hand. The empty file may stay after the lock is released, and means nothing.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

ASK_EVERY = 5.0
"""seconds after which somebody who waits is told so, again and again"""


@contextmanager
def exclusive(
    path: str | os.PathLike[str],
    waiting: Callable[[], None] = lambda: None,
    poll: float = 0.05,
) -> Iterator[None]:
    """Do the body while no other process or thread is in a body of the same lock.

    Args:
        path: the lock's file; its folder is made if missing.
        waiting: called every `ASK_EVERY` seconds while somebody else is in.
        poll: seconds between two looks.

    Yields:
        Nothing, once the lock is had.

    Raises:
        OSError: the file cannot be made or opened for writing.
    """
    lock = _lock(path)
    while True:
        try:
            lock.acquire(timeout=ASK_EVERY, poll_interval=poll)
            break
        except Timeout:
            waiting()
    try:
        yield
    finally:
        lock.release()


@contextmanager
def claimed(path: str | os.PathLike[str]) -> Iterator[bool]:
    """Take a lock unless somebody else has it, for work that is then theirs; never waits.

    Args:
        path: as `exclusive`.

    Yields:
        Whether the lock was free, and is had during the body.

    Raises:
        OSError: as `exclusive`.
    """
    lock = _lock(path)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        yield False
        return
    try:
        yield True
    finally:
        lock.release()


def _lock(path: str | os.PathLike[str]) -> FileLock:
    place = Path(path)
    place.parent.mkdir(parents=True, exist_ok=True)
    return FileLock(place)
