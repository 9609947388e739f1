"""Work in progress on disk: what comes back, and what counts as absent."""

import warnings

import numpy as np
import pytest

from jaxface.io import checkpoint as checkpoint_module
from jaxface.io.checkpoint import Checkpoint

ARRAYS = {
    "image": np.linspace(0, 1, 24, dtype=np.float32).reshape(2, 4, 3),
    "file": np.arange(3),  # a name that numpy.savez takes for its own
    ".network.kernels['conv1_1']": np.float64(np.pi),
    "mask": np.array([[True, False]]),
    "empty": np.zeros((0, 2), np.int16),
}
RECORD = {"name": "256 px", "losses": [0.1, 1 / 3], "inner": {"none": None}}


@pytest.fixture
def checkpoint(tmp_path):
    return Checkpoint(tmp_path / "work", "key")


def test_what_is_written_comes_back(checkpoint) -> None:
    assert checkpoint.read("256") is None
    checkpoint.write("256", ARRAYS, RECORD)
    arrays, record = checkpoint.read("256")
    assert record == RECORD
    assert list(arrays) == list(ARRAYS)
    for name, value in ARRAYS.items():
        assert arrays[name].dtype == value.dtype, name
        np.testing.assert_array_equal(arrays[name], value)
    assert checkpoint.read("128") is None
    checkpoint.write("256", {}, {"second": True})
    assert checkpoint.read("256") == ({}, {"second": True})
    assert [path.name for path in checkpoint.folder.iterdir()] == ["256.npz"]


def test_another_key_is_absent_without_a_word_until_it_is_replaced(checkpoint) -> None:
    checkpoint.write("a", ARRAYS)
    other = Checkpoint(checkpoint.folder, "other key")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert other.read("a") is None
        assert checkpoint.read("a") is not None, "reading must not remove it"
        other.write("a", {"x": np.ones(2)})
        assert checkpoint.read("a") is None
        assert other.read("a") is not None


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"no archive",
        b"PK\x03\x04 cut off",
        b"\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, 'shape': (), }",
    ],
)
def test_a_foreign_file_is_absent_and_named(checkpoint, content) -> None:
    checkpoint.folder.mkdir()
    checkpoint.file("a").write_bytes(content)
    with pytest.warns(UserWarning, match=r"work.a\.npz is no whole checkpoint"):
        assert checkpoint.read("a") is None
    checkpoint.write("a", ARRAYS)
    assert checkpoint.read("a") is not None


@pytest.mark.parametrize(
    "entries",
    [
        {"x": 1},
        {"checkpoint": "no JSON"},
        {"checkpoint": "[]"},
        {"checkpoint": '{"key": "key"}'},
        {"checkpoint": '{"key": "key", "arrays": ["x"], "record": {}}'},
        {"checkpoint": '{"key": "key", "arrays": [], "record": 1}'},
    ],
)
def test_an_archive_of_something_else_is_absent_and_named(checkpoint, entries) -> None:
    checkpoint.folder.mkdir()
    np.savez(checkpoint.file("a"), **entries)
    with pytest.warns(UserWarning, match="no whole checkpoint"):
        assert checkpoint.read("a") is None


def test_no_damage_goes_unnoticed(checkpoint) -> None:
    """Every byte changed, and every length: None with a warning, or all as it was written."""
    checkpoint.write("a", {"x": np.arange(4, dtype=np.float32)}, {"step": 7})
    whole = checkpoint.file("a").read_bytes()
    changed = [whole[:i] + bytes([whole[i] ^ 0xFF]) + whole[i + 1 :] for i in range(len(whole))]
    cut = [whole[:length] for length in range(len(whole))]
    refused = 0
    for content in changed + cut:
        checkpoint.file("a").write_bytes(content)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            found = checkpoint.read("a")
        if found is None:
            refused += 1
            assert len(told) == 1
        else:
            assert found.record == {"step": 7}
            np.testing.assert_array_equal(found.arrays["x"], [0, 1, 2, 3])
    assert refused > len(cut)


def test_a_write_that_fails_leaves_what_was_there(checkpoint, monkeypatch) -> None:
    checkpoint.write("a", {"x": np.ones(2)})

    def savez(stream, **entries):
        stream.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(checkpoint_module.np, "savez", savez)
    with pytest.raises(OSError, match="disk full"):
        checkpoint.write("a", {"x": np.zeros(2)})
    np.testing.assert_array_equal(checkpoint.read("a").arrays["x"], [1, 1])
    assert [path.name for path in checkpoint.folder.iterdir()] == ["a.npz"]


def test_clearing_removes_the_pieces_and_nothing_else(checkpoint) -> None:
    checkpoint.clear()  # nothing there yet
    checkpoint.write("a", {})
    Checkpoint(checkpoint.folder, "other").write("b", {})
    checkpoint.clear()
    assert not checkpoint.folder.exists()
    checkpoint.write("a", {})
    (checkpoint.folder / "notes.txt").write_text("of the user")
    checkpoint.clear()
    assert [path.name for path in checkpoint.folder.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("name", ["", "../a", "a/b", ".hidden", "a b"])
def test_a_name_that_is_no_file_name_is_refused(checkpoint, name) -> None:
    for call in (lambda: checkpoint.read(name), lambda: checkpoint.write(name, {})):
        with pytest.raises(ValueError, match="needed are letters"):
            call()


def test_what_cannot_be_kept_is_refused(checkpoint) -> None:
    with pytest.raises(ValueError, match="array 'x' is of type object"):
        checkpoint.write("a", {"x": np.array([None])})
    with pytest.raises(TypeError, match="JSON"):
        checkpoint.write("a", {}, {"x": object()})
    assert checkpoint.read("a") is None
