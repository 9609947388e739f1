"""Files that are whole or absent: write beside the target, then rename over it."""

import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_TRIES, _PAUSE = 20, 0.05  # seconds
_REPLACES_OPEN_FILES = os.name != "nt"


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path to write to; on success it replaces ``path`` in one step.

    The temporary file lies in the same folder (made if missing), for a rename is atomic only
    within a file system, and keeps the suffix, for writers choose the format by it. When the body
    raises, the temporary file is removed and ``path`` is left as it was.

    Args:
        path: the file to write.

    Yields:
        The temporary path; the body has to write it.

    Raises:
        OSError: the folder cannot be made or written to, or the body has written nothing.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(
        prefix=f".{target.stem}-", suffix=target.suffix, dir=target.parent
    )
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        # mkstemp makes a private file; an output has the permissions of any other new file.
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        _replace(temporary, target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _replace(source: Path, target: Path) -> None:
    for _ in range(_TRIES):
        try:
            os.replace(source, target)
            return
        except PermissionError:
            # Windows replaces no file that another process has open, and readers are soon done.
            if _REPLACES_OPEN_FILES:
                raise
            time.sleep(_PAUSE)
    os.replace(source, target)
