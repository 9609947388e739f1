"""Arrays out of ``.safetensors`` files: a JSON header with offsets, then the raw numbers."""

import json
from pathlib import Path

import numpy as np

_TYPES = {
    "F64": "<f8",
    "F32": "<f4",
    "F16": "<f2",
    "I64": "<i8",
    "I32": "<i4",
    "I16": "<i2",
    "I8": "i1",
    "U8": "u1",
    "BOOL": "?",
}


def load_safetensors(path: str | Path) -> dict[str, np.ndarray]:
    """All arrays by name; bfloat16 becomes float32.

    Raises:
        ValueError: not such a file, a damaged one, or one with an unknown type; the message names
            the file.
        FileNotFoundError: there is no such file.
    """
    data = Path(path).read_bytes()
    try:
        length = int.from_bytes(data[:8], "little")
        if len(data) < 8 or length > len(data) - 8:
            raise ValueError(f"the header claims {length} bytes of {len(data)}")
        header = json.loads(data[8 : 8 + length])
        body = data[8 + length :]
        return {
            name: _array(body, entry) for name, entry in header.items() if name != "__metadata__"
        }
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: not a readable safetensors file ({error})") from error


def _array(body: bytes, entry: dict) -> np.ndarray:
    start, stop = entry["data_offsets"]
    raw, shape = body[start:stop], tuple(entry["shape"])
    if len(raw) != stop - start:
        raise ValueError("the file is cut short")
    if entry["dtype"] == "BF16":
        widened = np.frombuffer(raw, "<u2").astype(np.uint32) << 16
        return widened.view(np.float32).reshape(shape)
    if entry["dtype"] not in _TYPES:
        raise ValueError(f"type {entry['dtype']!r} is not read")
    return np.frombuffer(raw, _TYPES[entry["dtype"]]).reshape(shape)
