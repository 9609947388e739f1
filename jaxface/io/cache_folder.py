"""The folder of everything that is kept between runs."""

import os
from pathlib import Path

import platformdirs

ENVIRONMENT = "JAXFACE_CACHE"


def cache_dir() -> Path:
    """Folder of everything jaxface keeps: ``$JAXFACE_CACHE``, or the user's cache folder."""
    chosen = os.environ.get(ENVIRONMENT)
    return Path(chosen).expanduser() if chosen else Path(platformdirs.user_cache_dir("jaxface"))
