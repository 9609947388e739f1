"""What a result was made with: versions, system, processor, devices. No machine is named."""

import platform
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import jax

from jaxface._machine import usable_cores

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
