"""The folder of compiled programs: chosen, bounded, and never a reason to fail."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest

import jaxface
from jaxface.io.cache_folder import cache_dir
from jaxface.run.compile_cache import enable_compilation_cache


def current() -> str | None:
    return jax.config.values["jax_compilation_cache_dir"]


@pytest.fixture(autouse=True)
def restore_jax_config():
    names = [
        "jax_compilation_cache_dir",
        "jax_persistent_cache_min_compile_time_secs",
        "jax_persistent_cache_min_entry_size_bytes",
        "jax_persistent_cache_enable_xla_caches",
    ]
    before = {name: jax.config.values[name] for name in names}
    yield
    for name, value in before.items():
        jax.config.update(name, value)


def test_environment_chooses_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("JAXFACE_CACHE", str(tmp_path / "kept"))
    folder = enable_compilation_cache()
    assert cache_dir() == tmp_path / "kept"
    assert folder is not None and folder.is_dir() and folder.parent == cache_dir()
    assert current() == str(folder)


def test_empty_environment_switches_it_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("JAXFACE_CACHE", "")
    before = current()
    assert enable_compilation_cache() is None
    assert current() == before


def test_unwritable_folder_warns(tmp_path: Path) -> None:
    occupied = tmp_path / "file"
    occupied.write_text("not a folder")
    with pytest.warns(UserWarning, match="cannot be written"):
        assert enable_compilation_cache(occupied / "xla") is None


def test_oldest_entries_are_pruned(tmp_path: Path) -> None:
    for age, name in enumerate(["new", "middle", "old"]):
        (tmp_path / name).write_bytes(b"x" * 100)
        os.utime(tmp_path / name, (1e9 - age, 1e9 - age))
    enable_compilation_cache(tmp_path, maximum_bytes=250)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["middle", "new"]


def test_a_second_process_finds_the_first_ones_program(tmp_path: Path) -> None:
    code = (
        "import jax, sys\n"
        "from jaxface.run.compile_cache import enable_compilation_cache\n"
        "enable_compilation_cache(sys.argv[1], minimum_seconds=0.0)\n"
        "jax.monitoring.register_event_listener(\n"
        "    lambda name, **kw: print(name) if name.endswith('cache_hits') else None)\n"
        "print(jax.jit(lambda x: jax.numpy.sin(x) * 3)(1.0))\n"
    )
    hits = [
        subprocess.run(
            [sys.executable, "-c", code, str(tmp_path)], check=True, capture_output=True, text=True
        ).stdout.count("cache_hits")
        for _ in range(2)
    ]
    assert hits[0] == 0 and hits[1] > 0


CHILD = """
import os, sys
import jax
jax.numpy.zeros(3).block_until_ready()  # JAX has begun before the cache is asked for
{before}
from jaxface.run.compile_cache import keep_compiled
from jaxface.pipeline.fitting import _fit
assert not sys.argv[1] or not os.path.exists(sys.argv[1]), "importing made a folder"
try:
    _fit.fit("there is no such photo")
except FileNotFoundError:
    pass
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.jit(lambda x: jax.numpy.sin(x) * 3)(1.0).block_until_ready()
print(jax.config.values["jax_compilation_cache_dir"])
"""


@pytest.mark.parametrize(
    ("cache", "before", "used"),
    [
        ("kept", "", "kept"),
        ("", "", None),
        ("kept", "jax.config.update('jax_compilation_cache_dir', sys.argv[2])", "mine"),
        ("kept", "jax.config.update('jax_enable_compilation_cache', False)", None),
    ],
)
def test_a_fit_in_python_keeps_what_it_compiles(tmp_path, cache, before, used) -> None:
    kept = str(tmp_path / cache) if cache else ""
    done = subprocess.run(
        [sys.executable, "-c", CHILD.format(before=before), kept, str(tmp_path / "mine")],
        env={**os.environ, "JAXFACE_CACHE": kept},
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    folder = done.stdout.strip().splitlines()[-1]
    if used is None:
        assert folder == "None" and not list(tmp_path.iterdir())
    else:
        assert Path(folder).is_relative_to(tmp_path / used)
        assert [path for path in Path(folder).iterdir() if path.name.startswith("jit_")]


def test_the_name_is_public() -> None:
    assert jaxface.enable_compilation_cache is enable_compilation_cache
