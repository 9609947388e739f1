"""Memory of large arrays: used again rather than handed back to the system after every call."""

import ctypes
import platform

import jax

# <malloc.h> of glibc
_TRIM_THRESHOLD, _MMAP_MAX = -1, -4
_NEVER = 2**31 - 1
_GLIBC = platform.system() == "Linux" and platform.libc_ver()[0] == "glibc"


def keep_freed_memory() -> bool:
    """Let the process keep what its programs have freed, for their next call.

    On Linux the C library hands large blocks back at once, and the system clears every page of the
    next call's again: a tenth of an evaluation of eq. 3 at 512 px, or of a fit. What a program
    needs stays with the process afterwards, until it ends. To take it from one heap, JAX then runs
    CPU programs on the thread that calls them, which only matters to a caller that has something
    else to do meanwhile.

    To be called before the first computation. Meant for processes that are the command's own, or a
    user's script; importing the package changes nothing.

    Returns:
        Whether anything was changed: False on other systems and C libraries.
    """
    if not _GLIBC:
        return False
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    mallopt = ctypes.CDLL(None).mallopt
    return bool(mallopt(_MMAP_MAX, 0)) and bool(mallopt(_TRIM_THRESHOLD, _NEVER))


def hand_back_freed_memory() -> None:
    """Hand back what is freed and kept: between two parts of a run that need other sizes.

    Each part then starts with what is in use alone, and not with the holes that the last one left.
    Does nothing where the C library is not glibc.
    """
    if _GLIBC:
        ctypes.CDLL(None).malloc_trim(0)
