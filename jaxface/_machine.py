"""What the machine can do."""

import functools


@functools.cache
def processor_features() -> str:
    """What this machine's processor can do, as Linux tells it; empty on other systems."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            return next(x for x in lines if x.lower().startswith(("flags", "features")))
    except (OSError, StopIteration):
        return ""
