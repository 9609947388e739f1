"""What a result was made with: versions, system, processor, devices. No machine is named."""

import os
import platform
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import jax

PACKAGES = ("jaxface", "jax", "jaxlib", "equinox", "optimistix", "lineax", "numpy", "scikit-image")


def environment(packages: Iterable[str] = PACKAGES) -> dict[str, Any]:
    """Versions of the packages that are installed, and the hardware, ready for JSON."""
    devices = jax.devices()
    return {
        "versions": {"python": platform.python_version(), **installed_versions(packages)},
        "system": f"{platform.system()} {platform.machine()}",
        "processor": processor_name(),
        "cores": usable_cores(),
        "device": devices[0].device_kind,
        "device_count": len(devices),
        "x64": bool(jax.config.read("jax_enable_x64")),
    }


def installed_versions(packages: Iterable[str]) -> dict[str, str]:
    """Versions by distribution name; those that are not installed are left out."""
    found = {}
    for package in packages:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def processor_name() -> str:
    """The processor as it calls itself, else its architecture."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            for line in lines:
                if line.startswith("model name"):
                    return line.split(":", 1)[1].strip()
    except OSError:
        pass  # no such file outside Linux
    return platform.processor() or platform.machine()


def usable_cores() -> int:
    """Cores that this process may use, which a container may make fewer than there are."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
