"""Large blocks stay with the process where that is asked for."""

import platform
import subprocess
import sys

import pytest

FAULTS = """
import resource, sys
import jax, jax.numpy as jnp
from jaxface.run.memory import keep_freed_memory

if sys.argv[1] == "keep":
    assert keep_freed_memory()
step = jax.jit(lambda x: jnp.linalg.norm(jnp.outer(x, x) @ jnp.outer(x, x)))
x = jnp.ones(2000)
for _ in range(3):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    step(x).block_until_ready()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


RESIDENT = """
import os
import numpy as np
from jaxface.run.memory import hand_back_freed_memory, keep_freed_memory

def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") // 1_000_000

assert keep_freed_memory()
large, later = np.ones(50_000_000), np.ones(1000)  # 400 MB, and what keeps the heap's end
full = resident()
del large
kept = resident()
hand_back_freed_memory()
print(full, kept, resident())
"""

only_glibc = pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc" or sys.platform != "linux", reason="glibc's own setting"
)


def output(script: str, *arguments: str) -> str:
    command = [sys.executable, "-c", script, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


@only_glibc
def test_a_program_finds_its_memory_again():
    faults = {mode: int(output(FAULTS, mode)) for mode in ("keep", "give back")}
    assert faults["keep"] < 0.1 * faults["give back"]


@only_glibc
def test_what_was_kept_is_handed_back_when_asked():
    full, kept, after = map(int, output(RESIDENT).split())
    assert kept > full - 50
    assert after < full - 350
