"""A digest of what a result was made from, by which a kept result is known to be of it."""

import hashlib

import numpy as np

from jaxface._types import Array


def digest(*parts: str | bytes | np.ndarray | Array) -> str:
    """32 hexadecimal digits of texts and arrays, with the arrays' shapes and types."""
    total = hashlib.blake2b(digest_size=16)
    for part in parts:
        if isinstance(part, str | bytes):
            data = part.encode() if isinstance(part, str) else part
            total.update(f"{len(data)};".encode())
        else:
            data = np.ascontiguousarray(part)
            total.update(f"{data.shape}{data.dtype.str};".encode())
        total.update(bytes(data))
    return total.hexdigest()
