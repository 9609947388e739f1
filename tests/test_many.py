"""A folder of photos by many processes: shards, locks, a shared database, a scheduler."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxface.io import atomic
from jaxface.io.atomic import atomic_path
from jaxface.io.face_models import load_model
from jaxface.io.file_lock import claimed, exclusive
from jaxface.io.texture_database import INDEX, TextureDatabase
from jaxface.pipeline.cluster import digitize_on_cluster, run_on_cluster
from jaxface.pipeline.databases import painted
from jaxface.pipeline.databases.painted import synth_database
from jaxface.pipeline.folder import (
    LOCKS,
    Journey,
    folders_of,
    reason,
    run_folder,
    shard_of,
)
from jaxface.pipeline.options import DigitizeOptions
from jaxface.pipeline.photo import photos_in
from jaxface.stages.fit.options import FitOptions
from tests.photo_stamps import Stamps, photos, processes, written

ROOT = Path(__file__).resolve().parent.parent


def start(code: str, *arguments: object) -> subprocess.Popen:
    """Another Python process with this package and the tests in its path."""
    known = {
        "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
        "JAX_COMPILATION_CACHE_DIR": str(jax.config.values["jax_compilation_cache_dir"] or ""),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.3",
    }
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)], env={**os.environ, **known},
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip


def answer(process: subprocess.Popen) -> str:
    said, _ = process.communicate()
    assert process.returncode == 0
    return said


@given(st.sets(st.text("abcXYZ019 é", min_size=1, max_size=6), max_size=20), st.integers(1, 9))
def test_shards_are_disjoint_even_and_together_all(names, count):
    found = [Path("in") / f"{name}.png" for name in names]
    shards = [shard_of(found, f"{k}/{count}") for k in range(1, count + 1)]
    assert sorted(p for shard in shards for p in shard) == sorted(found)
    sizes = [len(shard) for shard in shards]
    assert max(sizes) - min(sizes) <= 1
    assert shards == [shard_of(found[::-1], f"{k}/{count}") for k in range(1, count + 1)]


def test_shards_go_by_name_on_every_machine():
    composed, taken_apart = "\u00e9.png", "e\u0301.png"
    found = [Path(name) for name in ("b.png", taken_apart, "B.png", "a.png")]
    assert [p.name for p in shard_of(found, "1/1")] == ["B.png", "a.png", "b.png", taken_apart]
    again = [Path(name) for name in ("b.png", composed, "B.png", "a.png")]
    assert shard_of(found, "2/3") == shard_of(again, "2/3") == [Path("a.png")]
    assert shard_of(found, "9/9") == []


@pytest.mark.parametrize("shard", ["0/8", "9/8", "3", "3/0", "-1/8", "a/b", "3/8/9", "", "1.0/2"])
def test_a_shard_that_is_none_is_an_error(shard):
    with pytest.raises(ValueError, match="needed is K/N"):
        shard_of([Path("a.png")], shard)


def test_photos_of_two_shards_may_not_share_a_folder(tmp_path):
    with pytest.raises(ValueError, match="share a folder"):
        shard_of([Path("a.png"), Path("a.jpg")], "1/2")
    with pytest.raises(ValueError, match="share a folder"):
        folders_of([Path("a.png"), Path("a.jpg")], tmp_path)


def test_hidden_files_are_no_photos(tmp_path):
    for name in ("b.png", "a.JPG", "._a.JPG", "notes.txt"):
        (tmp_path / name).write_bytes(b"")
    assert [p.name for p in photos_in(tmp_path)] == ["a.JPG", "b.png"]


def test_a_photo_that_fails_does_not_end_the_run_and_a_later_run_goes_on(tmp_path):
    found = photos(tmp_path / "in")
    found[2].write_bytes(b"broken")
    begun = []
    entries = list(run_folder(found, tmp_path / "out", Stamps(), begun.append))
    assert begun == found
    assert [e.state for e in entries] == ["written"] * 2 + ["failed"] + ["written"] * 4
    assert entries[2].error.startswith("RuntimeError: photo 2.png is broken (photo_stamps.py, line")
    found[2].write_bytes(b"mended")
    again = list(run_folder(found, tmp_path / "out", Stamps(), begun.append))
    assert begun[7:] == [found[2]]
    assert [e.state for e in again] == ["present"] * 2 + ["written"] + ["present"] * 4
    assert len(processes(tmp_path / "out")) == 7
    assert reason(ValueError("no face")) == "no face"


def test_a_photo_that_another_process_is_at_is_left_to_it(tmp_path):
    found, out = photos(tmp_path / "in", 3), tmp_path / "out"
    with claimed(out / LOCKS / "photo 0.lock") as free:
        assert free
        entries = list(run_folder(found, out, Stamps()))
        assert [(e.photo, e.state) for e in entries] == [
            (found[1], "written"), (found[2], "written"), (found[0], "taken"),
        ]  # fmt: skip
    assert [e.state for e in run_folder(found, out, Stamps())] == ["written", "present", "present"]


def test_the_lock_of_a_killed_process_is_free(tmp_path):
    code = """
import sys
from jaxface.io.file_lock import exclusive
with exclusive(sys.argv[1]):
    print("held", flush=True)
    sys.stdin.read()
"""
    with start(code, tmp_path / "lock") as process:
        assert process.stdout.readline() == "held\n"
        with claimed(tmp_path / "lock") as free:
            assert not free
        process.kill()
        process.wait()
    with claimed(tmp_path / "lock") as free:
        assert free


def test_who_waits_for_a_lock_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr("jaxface.io.file_lock.ASK_EVERY", 0.0)
    told = []
    outer = exclusive(tmp_path / "lock")
    outer.__enter__()

    def waiting() -> None:
        told.append("waiting")
        if len(told) == 3:
            outer.__exit__(None, None, None)

    with exclusive(tmp_path / "lock", waiting):
        assert told == ["waiting"] * 3


FOLDER = """
import sys
from pathlib import Path
from jaxface.pipeline.folder import run_folder, shard_of
from jaxface.pipeline.photo import photos_in
from tests.photo_stamps import Stamps
photos = photos_in(sys.argv[1])
photos = shard_of(photos, sys.argv[3]) if len(sys.argv) > 3 else photos
print(len(list(run_folder(photos, sys.argv[2], Stamps()))))
"""


def test_two_processes_write_the_files_of_one_and_each_photo_once(tmp_path):
    """One has a shard, the other all photos: what both want, one of them does."""
    found = photos(tmp_path / "in", 24)
    pair = [
        start(FOLDER, tmp_path / "in", tmp_path / "two", "1/2"),
        start(FOLDER, tmp_path / "in", tmp_path / "two"),
    ]
    assert [int(answer(process)) for process in pair] == [12, 24]
    list(run_folder(found, tmp_path / "one", Stamps()))
    assert written(tmp_path / "two") == written(tmp_path / "one")
    assert len(processes(tmp_path / "two")) == 24


SUBJECTS = """
import sys
import numpy as np
from jaxface.io.face_models import load_model
from jaxface.io.texture_database import TextureDatabase
folder, me = sys.argv[1:]
database = TextureDatabase.create(
    folder, load_model("makehuman"), 16, name="grey", licence="CC0-1.0", credits=["of " + me]
)
print("begun", flush=True)
sys.stdin.readline()
for index in range(8):
    database.write_subject(f"{me}-{index}", np.full((16, 16, 3), 0.1 * index))
"""


def test_two_processes_add_to_one_database_and_no_entry_is_lost(tmp_path):
    pair = [start(SUBJECTS, tmp_path, name) for name in ("a", "b")]
    assert [process.stdout.readline() for process in pair] == ["begun\n"] * 2
    for process in pair:  # both at once
        process.stdin.write("go\n")
        process.stdin.flush()
    assert [answer(process) for process in pair] == ["", ""]
    database = TextureDatabase(tmp_path)
    assert sorted(database.names) == [f"{name}-{index}" for name in "ab" for index in range(8)]
    assert sorted(database.credits) == ["of a", "of b"]
    assert all(database.is_whole(name) for name in database.names)


PAINTING = """
import sys
import jax
import numpy as np
from jaxface.pipeline.databases import painted
count = []
def paint(face, layout, attributes, key, fields):
    count.append(1)
    print("paints", flush=True)
    sys.stdin.readline()
    return np.full((64, 64, 3), jax.random.uniform(key))
painted.synthesise_skin = paint
painted.skin_fields = lambda face: None
print(len(painted.synth_database(sys.argv[1], 4, 64)), len(count))
"""


def let_paint(process: subprocess.Popen, skins: int) -> None:
    for _ in range(skins):
        assert process.stdout.readline() == "paints\n"
        process.stdin.write("go\n")
        process.stdin.flush()


def test_a_second_process_goes_on_painting_where_a_killed_one_stopped(tmp_path):
    """What they have painted in the end is what one process paints, each skin once."""
    with start(PAINTING, tmp_path / "two") as first:
        let_paint(first, 1)
        assert first.stdout.readline() == "paints\n"  # the second, with the lock in its hands
        with start(PAINTING, tmp_path / "two") as second:
            first.kill()
            first.wait()
            let_paint(second, 3)
            assert answer(second) == "4 3\n"
    with start(PAINTING, tmp_path / "one") as alone:
        let_paint(alone, 4)
        assert answer(alone) == "4 4\n"
    one, two = (json.loads((tmp_path / n / INDEX).read_text()) for n in ("one", "two"))
    assert one == two and len(one["subjects"]) == 4
    for subject in one["subjects"]:
        files = [(tmp_path / n / subject["file"]).read_bytes() for n in ("one", "two")]
        assert files[0] == files[1]


def test_a_whole_database_is_opened_without_a_lock(tmp_path, monkeypatch):
    """It may lie where nothing can be written."""
    monkeypatch.setattr(painted, "synthesise_skin", lambda *given: np.full((64, 64, 3), 0.5))
    monkeypatch.setattr(painted, "skin_fields", lambda face: None)
    assert len(synth_database(tmp_path, 1, 64)) == 1

    def no_lock(*given: object) -> None:
        raise PermissionError("read-only")

    monkeypatch.setattr("jaxface.io.file_lock.FileLock", no_lock)
    assert len(synth_database(tmp_path, 1, 64)) == 1
    with pytest.raises(PermissionError):
        synth_database(tmp_path, 2, 64)


def test_a_replaced_file_that_somebody_reads_is_tried_again(tmp_path, monkeypatch):
    """On Windows, where it cannot be replaced meanwhile; elsewhere the error is the file's own."""
    replace, tries = os.replace, []

    def busy(source, target) -> None:
        tries.append(target)
        if len(tries) < 3:
            raise PermissionError("in use")
        replace(source, target)

    monkeypatch.setattr(atomic.os, "replace", busy)
    monkeypatch.setattr(atomic, "_PAUSE", 0.0)
    monkeypatch.setattr(atomic, "_REPLACES_OPEN_FILES", True)
    with pytest.raises(PermissionError), atomic_path(tmp_path / "file") as temporary:
        temporary.write_text("text")
    monkeypatch.setattr(atomic, "_REPLACES_OPEN_FILES", False)
    with atomic_path(tmp_path / "file") as temporary:
        temporary.write_text("text")
    assert len(tries) == 3 and (tmp_path / "file").read_text() == "text"
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_a_journey_goes_to_another_folder_and_process(tmp_path, monkeypatch):
    import pickle

    monkeypatch.chdir(tmp_path)
    Path("makehuman").mkdir()
    Path("skins").mkdir()
    Path("random").touch()
    options = DigitizeOptions(
        fit=FitOptions(size=128), complete=False, database=Path("skins"), features="random"
    )
    sent = pickle.loads(pickle.dumps(Journey(options).prepared().elsewhere()))
    assert sent.options == dataclasses.replace(options, database=str(tmp_path / "skins"))
    with pytest.raises(ValueError, match="MorphableModel in memory"):
        Journey(DigitizeOptions(model=load_model("makehuman"))).elsewhere()


def test_a_cut_completion_is_not_done(tmp_path):
    """The albedo is there before the report tells of it; the kept levels go last."""
    journey = Journey(DigitizeOptions())
    for name, done in [("report.json", False), ("albedo.png", True)]:
        (tmp_path / name).touch()
        assert journey.is_done(tmp_path) is done
    (tmp_path / ".completion").mkdir()
    assert not journey.is_done(tmp_path)
    assert Journey(DigitizeOptions(complete=False)).is_done(tmp_path)


def test_an_absent_scheduler_package_names_the_remedy(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'jaxface\[cluster\]'"):
        list(digitize_on_cluster([], tmp_path, "tcp://127.0.0.1:1"))


def test_a_scheduler_that_is_not_there(tmp_path, monkeypatch):
    pytest.importorskip("distributed", reason="needs the extra 'cluster'")
    monkeypatch.setattr("jaxface.pipeline.cluster.ANSWER_WITHIN", 0.5)
    with pytest.raises(ValueError, match="no scheduler answers at 'tcp://127.0.0.1:1'"):
        list(run_on_cluster([], tmp_path, "tcp://127.0.0.1:1", Stamps()))
    with pytest.raises(FileNotFoundError, match=r"nowhere\.json"):
        list(run_on_cluster([], tmp_path, "nowhere.json", Stamps()))


def test_two_workers_of_a_scheduler_write_the_files_of_one_process(tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed", reason="needs the extra 'cluster'")
    found = photos(tmp_path / "in", 12)
    found[5].write_bytes(b"broken")
    monkeypatch.setenv("JAXFACE_CACHE", str(tmp_path / "cache"))
    monkeypatch.syspath_prepend(str(ROOT))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
    cluster = distributed.LocalCluster(
        n_workers=2, threads_per_worker=2, processes=True, dashboard_address=None,
        scheduler_port=0, local_directory=str(tmp_path / "dask"),
    )  # fmt: skip
    with cluster:
        entries = list(run_on_cluster(found, tmp_path / "two", cluster.scheduler_address, Stamps()))
        again = list(run_on_cluster(found, tmp_path / "two", cluster.scheduler_address, Stamps()))
    assert sorted(e.photo for e in entries) == sorted(found)
    failed = [e for e in entries if e.state != "written"]
    assert [(e.photo, e.state) for e in failed] == [(found[5], "failed")]
    assert "photo 5.png is broken" in failed[0].error
    assert sorted(e.state for e in again) == ["failed", *["present"] * 11]
    list(run_folder(found, tmp_path / "one", Stamps()))
    assert written(tmp_path / "two") == written(tmp_path / "one")
    assert len(processes(tmp_path / "two")) == 11
    assert len(set(processes(tmp_path / "two"))) == 2
