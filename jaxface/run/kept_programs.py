"""Traced programs kept between processes, beside the compiled ones.

JAX's compilation cache spares a second process the work of XLA, not that of tracing Python into
the program it is looked up by, which for the fit is the greater part. Here the traced program
(StableHLO, by ``jax.export``) is kept too, under a name that holds everything it depends on:
shapes, static settings, versions, and a digest of this package's own source.
"""

import functools
import hashlib
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.export
import numpy as np

import jaxface
from jaxface._types import PyTree
from jaxface.io.atomic import atomic_path


def keep_structure(example: PyTree) -> None:
    """Let programs that return pytrees of this type be kept.

    Args:
        example: an instance; the type's static fields, if any, must always have its values.
    """
    kind = type(example)
    if kind in _KNOWN:
        return
    node = jax.tree.structure(example).node_data()
    if node is None:
        raise ValueError(f"{kind.__name__} is a leaf, not a pytree whose structure could be kept")
    static = node[1]
    jax.export.register_pytree_node_serialization(
        kind,
        serialized_name=f"{kind.__module__}.{kind.__qualname__}",
        serialize_auxdata=lambda static: b"",
        deserialize_auxdata=lambda data: static,
    )
    _KNOWN.add(kind)


_KNOWN: set[type] = set()


def kept_program(name: str, program: Callable[..., PyTree], *args: PyTree) -> Callable[..., PyTree]:
    """A jitted function, from the disk if an earlier process has traced it for such arguments.

    Where no compilation cache is in use, where a static argument has no lasting name (a function
    of the caller's), or where the file is damaged, the program is traced as ever.

    Args:
        name: of the program, the same in every process.
        program: jitted; what it returns is made of types that ``keep_structure`` knows.
        args: arrays, or ``jax.ShapeDtypeStruct``s of their shapes, in pytrees.

    Returns:
        A function of the arguments' leaves, to be jitted, with the program's answer.
    """
    leaves, structure = jax.tree.flatten(args)
    shapes = [jax.ShapeDtypeStruct(np.shape(x), jax.dtypes.canonicalize_dtype(_dtype(x)))
              for x in leaves]  # fmt: skip

    def flat(*leaves: Any) -> PyTree:
        return program(*structure.unflatten(leaves))

    folder = jax.config.values.get("jax_compilation_cache_dir")
    text = f"{name} {structure} {[(x.shape, str(x.dtype)) for x in shapes]}"
    if not folder or " at 0x" in text:
        return flat
    versions = f"{jaxface.__version__} {source_digest()} {jax.__version__} {jax.default_backend()}"
    wide = jax.config.values["jax_enable_x64"]
    digest = hashlib.sha256(f"{text} {versions} {wide}".encode()).hexdigest()
    path = Path(folder) / f"traced-{name}-{digest[:32]}"
    try:
        stored = jax.export.deserialize(bytearray(zlib.decompress(path.read_bytes())))
    except (OSError, ValueError, zlib.error, zipfile.BadZipFile):
        stored = jax.export.export(jax.jit(flat))(*shapes)
        try:
            with atomic_path(path) as temporary:
                Path(temporary).write_bytes(zlib.compress(bytes(stored.serialize()), 1))
        except OSError:
            pass  # a folder that cannot be written costs the speed of the next start, no more
    return stored.call


def _dtype(x: Any) -> Any:
    return x.dtype if hasattr(x, "dtype") else np.result_type(x)


@functools.cache
def source_digest() -> str:
    """Of this package's code: what it wrote can differ from what other code would write."""
    digest = hashlib.sha256()
    for path in sorted(Path(jaxface.__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
