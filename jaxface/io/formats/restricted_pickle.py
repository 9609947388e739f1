"""Reading arrays out of pickles without running what a pickle asks to run.

A pickle names functions to call, so a plain ``pickle.load`` runs whatever its author chose. Here
only an explicit table of names resolves; everything else raises. Classes of chumpy and
scipy.sparse, which old face models contain, resolve to passive records of their own state, so
neither package is needed and no code of theirs runs.
"""

import io
import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

_RECONSTRUCT = np.ndarray(0).__reduce__()[0]


class UnsafePickleError(ValueError):
    """A pickle asks for a name outside the table of allowed ones."""


class _Record:
    """A foreign object reduced to its attributes."""

    def __new__(cls, *args: object, **kwargs: object) -> "_Record":
        return object.__new__(cls)

    def __init__(self, *args: object) -> None:
        """Positional arguments are kept as they came: old pickles pass the base class's state."""
        self.arguments = args

    def __setstate__(self, state: object) -> None:
        if isinstance(state, tuple) and len(state) == 2:
            state = {**(state[0] or {}), **(state[1] or {})}
        if not isinstance(state, dict):
            raise UnsafePickleError(f"{type(self).__name__} has a state of {type(state).__name__}")
        self.__dict__.update(state)


class _Chumpy(_Record):
    """An expression of chumpy; ``kind`` is the name of its class."""

    kind = ""


class _Sparse(_Record):
    """A scipy.sparse matrix; ``kind`` is the name of its class."""

    kind = ""


def _reconstructor(cls: type, base: type, state: object) -> object:
    """``copyreg._reconstructor`` for records and plain objects alone."""
    if not (isinstance(cls, type) and issubclass(cls, _Record)):
        raise UnsafePickleError(f"refused to reconstruct {cls!r}")
    return object.__new__(cls)


def _encode(text: str, encoding: str) -> bytes:
    """How a protocol-2 pickle written by Python 3 spells bytes."""
    if encoding not in ("latin1", "latin-1", "iso-8859-1"):
        raise UnsafePickleError(f"refused to encode text as {encoding!r}")
    return text.encode("latin-1")


def _array_names() -> dict[tuple[str, str], Any]:
    """Everything a pickle of NumPy arrays and plain containers may call."""
    scalar = np.float64(0).__reduce__()[0]
    frombuffer = np.zeros(1).__reduce_ex__(5)[0]
    names: dict[tuple[str, str], Any] = {
        ("numpy", "ndarray"): np.ndarray,
        ("numpy", "dtype"): np.dtype,
        ("_codecs", "encode"): _encode,
        ("collections", "OrderedDict"): OrderedDict,
    }
    for core in ("numpy.core", "numpy._core"):
        names[f"{core}.multiarray", "_reconstruct"] = _RECONSTRUCT
        names[f"{core}.multiarray", "scalar"] = scalar
        names[f"{core}.numeric", "_frombuffer"] = frombuffer
    for builtins in ("__builtin__", "builtins"):
        for kind in (set, frozenset, list, dict, tuple, bytearray, complex, object, slice):
            names[builtins, kind.__name__] = kind
    for copyreg in ("copy_reg", "copyreg"):
        names[copyreg, "_reconstructor"] = _reconstructor
    return names


ARRAYS: Mapping[tuple[str, str], Any] = _array_names()
"""``(module, name) -> object`` for arrays and containers; extend a copy of it for more."""


class RestrictedUnpickler(pickle.Unpickler):
    """Resolves the names of ``allowed`` and nothing else; foreign arrays become records."""

    def __init__(
        self, file: BinaryIO, allowed: Mapping[tuple[str, str], Any] = ARRAYS, **options: Any
    ) -> None:
        super().__init__(file, **options)
        self._allowed = allowed

    def find_class(self, module: str, name: str) -> Any:
        """The object that a pickle means by ``module.name``.

        Raises:
            UnsafePickleError: the name is not in the table.
        """
        if (module, name) in self._allowed:
            return self._allowed[module, name]
        if module == "chumpy" or module.startswith("chumpy."):
            return type(f"chumpy.{name}", (_Chumpy,), {"kind": name})
        if module.startswith("scipy.sparse") and name.endswith(("_matrix", "_array")):
            return type(name, (_Sparse,), {"kind": name[:3]})
        raise UnsafePickleError(
            f"the pickle asks for {module}.{name}; only arrays, containers, chumpy and "
            "scipy.sparse values are read"
        )


def load_pickle(
    source: str | Path | bytes,
    *,
    allowed: Mapping[tuple[str, str], Any] = ARRAYS,
    encoding: str = "latin1",
) -> Any:
    """Read a pickle of arrays; chumpy values and sparse matrices come out as dense arrays.

    Args:
        source: a file, or the pickle's bytes.
        allowed: the names that may be resolved.
        encoding: how the 8-bit strings of Python 2 are read.

    Raises:
        ValueError: the file is no pickle, is cut short, or asks for a name that is not allowed
            (`UnsafePickleError`); the message names the file.
        FileNotFoundError: there is no such file.
    """
    label = "pickle" if isinstance(source, bytes) else str(source)
    data = source if isinstance(source, bytes) else Path(source).read_bytes()
    try:
        return dense(RestrictedUnpickler(io.BytesIO(data), allowed, encoding=encoding).load())
    except UnsafePickleError as error:
        raise UnsafePickleError(f"{label}: {error}") from error
    except Exception as error:  # a damaged pickle can fail in any way its opcodes allow
        raise ValueError(f"{label}: not a readable pickle of arrays ({error})") from error


def dense(value: Any) -> Any:
    """Replace every chumpy or sparse record in nested containers by its NumPy array."""
    if isinstance(value, dict):
        return {key: dense(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(dense(item) for item in value)
    if isinstance(value, _Sparse):
        return _dense_sparse(value)
    if isinstance(value, _Chumpy):
        return _dense_chumpy(value)
    if isinstance(value, np.ndarray) and value.dtype == object and value.size == 1:
        return dense(value.item())
    return value


def _attribute(record: _Record, *names: str) -> Any:
    for name in names:
        if name in record.__dict__:
            return record.__dict__[name]
    raise UnsafePickleError(f"{type(record).__name__} without {' or '.join(names)}")


def _dense_chumpy(record: _Chumpy) -> np.ndarray:
    """The value of the chumpy expressions that model files contain: leaves and reorderings."""
    if record.kind in ("Ch", "Variable"):
        return np.asarray(dense(_attribute(record, "x")))
    if record.kind == "Select":
        picked = np.asarray(dense(_attribute(record, "a"))).ravel()[_attribute(record, "idxs")]
        return picked.reshape(record.__dict__.get("preferred_shape", picked.shape))
    if record.kind == "Reshape":
        return np.asarray(dense(_attribute(record, "a"))).reshape(_attribute(record, "newshape"))
    if record.kind == "transpose":
        return np.transpose(dense(_attribute(record, "a")), record.__dict__.get("axes"))
    if record.kind == "Concatenate":
        parts = [dense(_attribute(record, term)) for term in _attribute(record, "dterms")]
        return np.concatenate(parts, axis=record.__dict__.get("axis", 0))
    raise UnsafePickleError(f"chumpy.{record.kind} is no stored array; save its value instead")


def _dense_sparse(record: _Sparse) -> np.ndarray:
    from scipy import sparse

    shape = tuple(int(n) for n in _attribute(record, "_shape", "shape"))
    data = np.asarray(_attribute(record, "data"))
    if record.kind in ("csc", "csr"):
        build = sparse.csc_matrix if record.kind == "csc" else sparse.csr_matrix
        parts = (data, _attribute(record, "indices"), _attribute(record, "indptr"))
        matrix = build(parts, shape=shape)
        matrix.check_format(full_check=True)
        return matrix.toarray()
    if record.kind == "coo":
        coordinates = record.__dict__.get("coords")
        row, column = coordinates or (_attribute(record, "row"), _attribute(record, "col"))
        return sparse.coo_matrix((data, (row, column)), shape=shape).toarray()
    raise UnsafePickleError(f"sparse matrices of kind {record.kind!r} are not read")


def load_npz(path: str | Path) -> dict[str, Any]:
    """Read an ``.npz`` whose object arrays, if any, pass through the restricted unpickler.

    Raises:
        ValueError: not an npz file, a damaged member, or a member that asks for a name that is
            not allowed; the message names the file.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            names = [n for n in archive.namelist() if n.endswith(".npy")]
            return {name[:-4]: load_npy(archive.read(name), str(path)) for name in names}
    except zipfile.BadZipFile as error:
        raise ValueError(f"{path}: not an npz file ({error})") from error


def load_npy(data: bytes | Path, label: str | None = None) -> Any:
    """One ``.npy``, of plain or of object dtype, under the same restrictions.

    Raises:
        ValueError: not an npy file, damaged, or asking for a name that is not allowed.
    """
    label = label or str(data)
    stream = io.BytesIO(data if isinstance(data, bytes) else data.read_bytes())
    try:
        version = np.lib.format.read_magic(stream)
        read = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }.get(version, np.lib.format.read_array_header_2_0)
        _, _, dtype = read(stream)
        if dtype.hasobject:
            return load_pickle(stream.read())
        stream.seek(0)
        return np.load(stream, allow_pickle=False)
    except ValueError as error:
        raise ValueError(f"{label}: {error}") from error
