"""What the machine can do."""

import functools
import os


@functools.cache
def processor_features() -> str:
    """What this machine's processor can do, as Linux tells it; empty on other systems."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            return next(x for x in lines if x.lower().startswith(("flags", "features")))
    except (OSError, StopIteration):
        return ""


def usable_cores() -> int:
    """Cores that this process may use, which a container may make fewer than there are."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
