"""Pickles of arrays are read; pickles that would run something are refused."""

import os
import pickle
from collections import OrderedDict

import numpy as np
import pytest
import scipy.sparse
from hypothesis import given
from hypothesis import strategies as st

from jaxface.io.formats.restricted_pickle import UnsafePickleError, load_npy, load_npz, load_pickle


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_arrays_and_containers_come_back(protocol) -> None:
    value = OrderedDict(
        a=np.arange(6.0).reshape(2, 3),
        b=np.asfortranarray(np.arange(6).reshape(2, 3)),
        c=[np.float32(2.5), b"bytes", "text", (1, None), {1, 2}],
    )
    back = load_pickle(pickle.dumps(value, protocol=protocol))
    np.testing.assert_array_equal(back["a"], value["a"])
    np.testing.assert_array_equal(back["b"], value["b"])
    assert back["c"] == value["c"]


@given(st.binary(max_size=60))
def test_any_bytes_give_a_value_or_a_value_error(data) -> None:
    try:
        load_pickle(data)
    except ValueError:
        pass


@pytest.mark.parametrize("kind", ["csc", "csr", "coo"])
def test_sparse_matrices_come_back_dense(kind) -> None:
    matrix = np.array([[0.0, 2.0, 0.0], [1.0, 0.0, 3.0]])
    sparse = scipy.sparse.coo_matrix(matrix).asformat(kind)
    np.testing.assert_array_equal(load_pickle(pickle.dumps(sparse, protocol=2)), matrix)


def test_the_old_module_path_of_sparse_matrices() -> None:
    sparse = scipy.sparse.csc_matrix(np.eye(2))
    data = pickle.dumps(sparse, protocol=2).replace(b"scipy.sparse._csc", b"scipy.sparse.csc")
    np.testing.assert_array_equal(load_pickle(data), np.eye(2))


def test_a_sparse_matrix_with_foreign_indices_is_refused() -> None:
    sparse = scipy.sparse.csc_matrix(np.eye(3))
    sparse.indices[1] = 10_000_000
    with pytest.raises(ValueError, match="not a readable pickle"):
        load_pickle(pickle.dumps(sparse, protocol=2))


class _Runs:
    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize(
    "attack",
    [
        _Runs(os.system, "touch owned"),
        _Runs(eval, "open('owned', 'w')"),
        _Runs(getattr, np.float64, "__subclasses__"),
        _Runs(np.load, "owned"),
        [np.zeros(2), {"deep": _Runs(os.mkdir, "owned")}],
    ],
    ids=["system", "eval", "getattr", "numpy function", "nested"],
)
@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_nothing_runs(attack, protocol, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "attack.pkl"
    file.write_bytes(pickle.dumps(attack, protocol=protocol))
    with pytest.raises(UnsafePickleError, match=r"attack\.pkl: the pickle asks for"):
        load_pickle(file)
    assert [path.name for path in tmp_path.iterdir()] == ["attack.pkl"]


def test_a_record_is_no_way_to_run_code(tmp_path, monkeypatch) -> None:
    """A chumpy class is called with whatever the pickle says; nothing of it may be executed."""
    monkeypatch.chdir(tmp_path)
    data = b"\x80\x02cchumpy.ch\nsystem\nX\x0b\x00\x00\x00touch owned\x85R."
    with pytest.raises(ValueError, match=r"chumpy\.system is no stored array"):
        load_pickle(data)
    assert not list(tmp_path.iterdir())


def test_object_members_of_npz_go_through_the_same_gate(tmp_path) -> None:
    good, bad = tmp_path / "good.npz", tmp_path / "bad.npz"
    table = np.array(scipy.sparse.csc_matrix(np.eye(2)), dtype=object)
    np.savez(good, plain=np.arange(3), table=table)
    np.savez(bad, x=np.array(_Runs(os.getcwd), dtype=object))
    content = load_npz(good)
    np.testing.assert_array_equal(content["plain"], np.arange(3))
    np.testing.assert_array_equal(content["table"], np.eye(2))
    with pytest.raises(ValueError, match=r"bad\.npz.*asks for"):
        load_npz(bad)


def test_npy_with_a_dictionary(tmp_path) -> None:
    file = tmp_path / "embedding.npy"
    np.save(file, {"x": np.arange(3)}, allow_pickle=True)
    np.testing.assert_array_equal(load_npy(file)["x"], np.arange(3))


def test_damaged_files_are_named(tmp_path) -> None:
    whole = pickle.dumps(np.arange(100.0))
    for name, data in {"cut.pkl": whole[:-50], "empty.pkl": b"", "text.pkl": b"hello"}.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(ValueError, match=name):
            load_pickle(tmp_path / name)
    (tmp_path / "cut.npz").write_bytes(b"PK\x03\x04 nothing more")
    with pytest.raises(ValueError, match=r"cut\.npz"):
        load_npz(tmp_path / "cut.npz")
