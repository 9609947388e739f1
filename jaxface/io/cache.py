"""Where compiled programs are kept between runs, so that the second start is quick."""

import os
import tempfile
import warnings
from pathlib import Path

import jax
import platformdirs

ENVIRONMENT = "JAXFACE_CACHE"


def cache_dir() -> Path:
    """Folder of everything jaxface keeps: ``$JAXFACE_CACHE``, or the user's cache folder."""
    chosen = os.environ.get(ENVIRONMENT)
    return Path(chosen).expanduser() if chosen else Path(platformdirs.user_cache_dir("jaxface"))


def enable_compilation_cache(
    directory: str | os.PathLike[str] | None = None, minimum_seconds: float = 0.2
) -> Path | None:
    """Let JAX keep the programs it compiles, and use those it has kept.

    JAX itself keys the entries by program, compiler version and hardware, so one folder serves
    several versions and machines. A folder that cannot be written costs a warning and the
    speed of a warm start, nothing else.

    Args:
        directory: the folder; by default ``xla`` in `cache_dir`. An empty ``$JAXFACE_CACHE``
            switches the cache off.
        minimum_seconds: programs that compile faster than this are not kept.

    Returns:
        The folder in use, or None where there is none.
    """
    if directory is None and os.environ.get(ENVIRONMENT) == "":
        return None
    folder = cache_dir() / "xla" if directory is None else Path(directory).expanduser()
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
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", minimum_seconds)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    # XLA's own sub-caches store absolute paths in the key, which a moved folder would miss.
    jax.config.update("jax_persistent_cache_enable_xla_caches", "none")
    return folder
