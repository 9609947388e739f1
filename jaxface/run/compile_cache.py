"""Where compiled programs are kept between runs, so that the second start is quick."""

import functools
import os
import platform
import tempfile
import warnings
import zlib
from pathlib import Path

import jax

from jaxface._machine import processor_features
from jaxface.io.cache_folder import ENVIRONMENT, cache_dir


def enable_compilation_cache(
    directory: str | os.PathLike[str] | None = None,
    minimum_seconds: float = 0.2,
    maximum_bytes: int = 2 * 1024**3,
) -> Path | None:
    """Let JAX keep the programs it compiles, and use those it has kept.

    JAX keys the entries by program, options and compiler version, so one folder serves several
    versions. A folder that cannot be written costs a warning and the speed of a warm start,
    nothing else.

    Args:
        directory: the folder; by default one under `cache_dir` for this kind of processor. An
            empty ``$JAXFACE_CACHE`` switches the cache off.
        minimum_seconds: programs that compile faster than this are not kept.
        maximum_bytes: at the start the oldest entries go until the folder holds no more.

    Returns:
        The folder in use, or None where there is none.
    """
    if directory is None and os.environ.get(ENVIRONMENT) == "":
        return None
    folder = Path(directory or cache_dir() / f"xla-{_processor_tag()}").expanduser()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        warnings.warn(
            f"compiled programs are not kept: {folder} cannot be written ({error.strerror}); "
            f"set {ENVIRONMENT} to a folder that can, or to nothing to switch this off",
            stacklevel=2,
        )
        return None
    _prune(folder, maximum_bytes)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", minimum_seconds)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    # XLA's own sub-caches put absolute paths into the key, which a moved folder would miss.
    jax.config.update("jax_persistent_cache_enable_xla_caches", "none")
    return folder


def keep_compiled() -> None:
    """``enable_compilation_cache`` where nobody has decided otherwise; what `fit` and its like do.

    Nothing is changed where JAX has a cache already, or is told to have none, or where
    ``$JAXFACE_CACHE`` is empty. After the first call of a process it costs next to nothing.
    """
    values = jax.config.values
    if values["jax_compilation_cache_dir"] or not values["jax_enable_compilation_cache"]:
        return
    _once()


@functools.cache
def _once() -> None:
    enable_compilation_cache()


def _processor_tag() -> str:
    """Name of this kind of processor, for a home folder may be shared by several kinds."""
    features = processor_features() or platform.processor()
    return f"{platform.machine() or 'any'}-{zlib.crc32(features.encode()):08x}"


def _prune(folder: Path, maximum_bytes: int) -> None:
    entries = []
    for path in folder.iterdir():
        try:
            status = path.stat()
        except OSError:
            continue  # another process pruned it
        entries.append((status.st_mtime, status.st_size, path))
    total = sum(size for _, size, _ in entries)
    for _, size, path in sorted(entries):
        if total <= maximum_bytes:
            return
        total -= size
        try:
            path.unlink(missing_ok=True)
        except OSError:
            continue  # in use elsewhere (Windows), or not ours
