"""Tensors out of files of ``torch.save``, without torch and without running what they contain.

Both formats are read: the zip archive of torch 1.6 and later, and the sequence of pickles before
it, in which torchvision's VGG weights were published.
"""

import io
import pickle
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxface.io.formats.restricted_pickle import ARRAYS, RestrictedUnpickler, UnsafePickleError

_STORAGES = {
    "DoubleStorage": np.dtype("<f8"),
    "FloatStorage": np.dtype("<f4"),
    "HalfStorage": np.dtype("<f2"),
    "LongStorage": np.dtype("<i8"),
    "IntStorage": np.dtype("<i4"),
    "ShortStorage": np.dtype("<i2"),
    "CharStorage": np.dtype("i1"),
    "ByteStorage": np.dtype("u1"),
    "BoolStorage": np.dtype("?"),
}

_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C


class _Storage:
    """A run of numbers, read when the file's second half gives them."""

    def __init__(self, dtype: np.dtype) -> None:
        self.dtype = dtype
        self.values = np.zeros(0, dtype)


class _Tensor:
    """A view of a storage."""

    def __init__(
        self, storage: _Storage, offset: int, size: tuple[int, ...], stride: tuple[int, ...]
    ) -> None:
        self.storage, self.offset, self.size, self.stride = storage, offset, size, stride

    def array(self) -> np.ndarray:
        """A copy as an array.

        Raises:
            ValueError: the view reaches beyond the storage.
        """
        values = self.storage.values
        layout = (self.offset, *self.size, *self.stride)
        if len(self.size) != len(self.stride) or any(int(x) != x or x < 0 for x in layout):
            raise ValueError(f"a tensor has size {self.size} and stride {self.stride}")
        if 0 in self.size:
            return np.zeros(self.size, values.dtype)
        last = self.offset + sum((n - 1) * s for n, s in zip(self.size, self.stride, strict=True))
        if last >= len(values):
            raise ValueError(f"a tensor needs {last + 1} numbers of a storage of {len(values)}")
        strides = tuple(s * values.itemsize for s in self.stride)
        view = np.lib.stride_tricks.as_strided(values[self.offset :], self.size, strides)
        return view.copy()


def _rebuild_tensor(
    storage: object, offset: int, size: tuple[int, ...], stride: tuple[int, ...], *_: object
) -> _Tensor:
    if not isinstance(storage, _Storage):
        raise UnsafePickleError("a tensor without a storage")
    return _Tensor(storage, offset, tuple(size), tuple(stride))


def _rebuild_parameter(data: object, *_: object) -> object:
    return data


_NAMES: Mapping[tuple[str, str], Any] = {
    **ARRAYS,
    ("torch._utils", "_rebuild_tensor"): _rebuild_tensor,
    ("torch._utils", "_rebuild_tensor_v2"): _rebuild_tensor,
    ("torch._utils", "_rebuild_parameter"): _rebuild_parameter,
    **{("torch", name): dtype for name, dtype in _STORAGES.items()},
}


class _Unpickler(RestrictedUnpickler):
    def __init__(self, file: Any, storage: Callable[[str, np.dtype, int], _Storage]) -> None:
        super().__init__(file, _NAMES, encoding="latin1")
        self._storage = storage

    def persistent_load(self, pid: Any) -> _Storage:
        """The storage that a tensor refers to: ('storage', type, key, device, count, ...)."""
        if not (isinstance(pid, tuple) and len(pid) >= 5 and pid[0] == "storage"):
            raise UnsafePickleError(f"an unknown reference {pid!r}")
        if not isinstance(pid[1], np.dtype):
            raise UnsafePickleError(f"an unknown storage {pid[1]!r}")
        if len(pid) > 5 and pid[5] is not None:
            raise UnsafePickleError("a view of a storage, which no longer exists in torch")
        return self._storage(str(pid[2]), pid[1], int(pid[4]))


def load_torch_tensors(path: str | Path) -> dict[str, np.ndarray]:
    """The tensors of a state dict, by name.

    Raises:
        ValueError: no file of ``torch.save``, a damaged one, one whose top is no dictionary, or
            one that asks for a name that is not allowed; the message names the file.
        FileNotFoundError: there is no such file.
    """
    data = Path(path).read_bytes()
    try:
        is_zip = zipfile.is_zipfile(io.BytesIO(data))
        value = _from_archive(data) if is_zip else _from_pickles(data)
        if isinstance(value, dict) and isinstance(value.get("state_dict"), dict):
            value = value["state_dict"]
        if not isinstance(value, dict):
            raise ValueError(f"the file holds a {type(value).__name__}, not a state dict")
        return {str(k): v.array() for k, v in value.items() if isinstance(v, _Tensor)}
    except UnsafePickleError as error:
        raise UnsafePickleError(f"{path}: {error}") from error
    except Exception as error:  # a damaged pickle can fail in any way its opcodes allow
        raise ValueError(f"{path}: not a readable file of torch.save ({error})") from error


def _from_archive(data: bytes) -> Any:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        root = next(n for n in archive.namelist() if n.endswith("data.pkl"))[: -len("data.pkl")]
        if f"{root}byteorder" in archive.namelist():
            order = archive.read(f"{root}byteorder").decode()
            if order != "little":
                raise ValueError(f"byte order {order!r} is not read")
        known: dict[str, _Storage] = {}

        def storage(key: str, dtype: np.dtype, count: int) -> _Storage:
            if key not in known:
                known[key] = _Storage(dtype)
                known[key].values = np.frombuffer(archive.read(f"{root}data/{key}"), dtype, count)
            return known[key]

        return _Unpickler(io.BytesIO(archive.read(f"{root}data.pkl")), storage).load()


def _from_pickles(data: bytes) -> Any:
    stream = io.BytesIO(data)
    known: dict[str, _Storage] = {}

    def storage(key: str, dtype: np.dtype, count: int) -> _Storage:
        return known.setdefault(key, _Storage(dtype))

    def following() -> Any:
        return _Unpickler(stream, storage).load()

    if following() != _LEGACY_MAGIC:
        raise pickle.UnpicklingError("the magic number of torch is missing")
    following()  # protocol version
    following()  # sizes of types on the machine that wrote it
    value = following()
    for key in following():
        count = int(np.frombuffer(stream.read(8), "<i8")[0])
        dtype = known[str(key)].dtype
        known[str(key)].values = np.frombuffer(stream.read(count * dtype.itemsize), dtype, count)
    return value
