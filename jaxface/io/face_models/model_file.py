"""Morphable models in jaxface's own format: one quantised ``.npz`` with JSON metadata."""

import functools
import json
import os
import zipfile
import zlib
from importlib import resources
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxface.io.atomic import atomic_path
from jaxface.models.linear import LinearBasis
from jaxface.models.morphable import MorphableModel, SurfacePoints

SCHEMA = 1
# Finest step of a stored basis: 2 micrometres for shape, 1e-5 for linear albedo. Finer digits
# would be noise that only makes the file bigger.
_BASES = {"identity": 2e-3, "expression": 2e-3, "albedo": 1e-5}
_LANDMARKS = {"landmarks68": 68, "landmarks468": 468}
_OCCLUSION = {"occlusion": (9,), "occlusion_slope": (3, 9)}


def bundled_models() -> list[str]:
    """Names of the models that come with the package."""
    folder = resources.files("jaxface") / "assets"
    return sorted(
        entry.name.removesuffix(".npz")
        for entry in folder.iterdir()
        if entry.name.endswith(".npz") and _is_model(entry)
    )


@functools.lru_cache(maxsize=1)
def load_bundled(name: str = "makehuman") -> MorphableModel:
    """A model that comes with the package; the last one is kept.

    Raises:
        ValueError: no bundled model has that name.
    """
    entry = resources.files("jaxface") / "assets" / f"{name}.npz"
    if not name.isidentifier() or not entry.is_file():
        raise ValueError(f"no bundled model {name!r}; the package has {bundled_models()}")
    with resources.as_file(entry) as path:
        return load_model(path)


def save_model(path: str | os.PathLike, model: MorphableModel, source: dict | None = None) -> None:
    """Write a model atomically; ``source`` (JSON-able) says how its data was made.

    Basis columns are stored as int16 multiples of a step per column: 2 micrometres (shape) or
    1e-5 (albedo), or 1/32767 of the column's largest entry where that is coarser.

    Raises:
        ValueError: ``path`` does not end in ``.npz``, or the model holds non-finite values.
    """
    path = Path(path)
    if path.suffix != ".npz":
        raise ValueError(f"a model file ends in .npz, got {str(path)!r}")
    arrays = {
        "mean": np.asarray(model.mean, np.float32),
        "albedo_mean": np.asarray(model.albedo_mean, np.float32),
        "faces": np.asarray(model.faces, np.int32),
        "uv": np.asarray(model.uv, np.float32),
        "uv_faces": np.asarray(model.uv_faces, np.int32),
        "region": np.asarray(model.region, np.uint8),
    }
    for name, finest in _BASES.items():
        basis: LinearBasis = getattr(model, name)
        steps, scale = _quantise(np.asarray(basis.basis, np.float64), finest)
        arrays[f"{name}_steps"] = steps
        arrays[f"{name}_scale"] = scale
        arrays[f"{name}_std"] = np.asarray(basis.std, np.float32)
    for name in _LANDMARKS:
        points: SurfacePoints | None = getattr(model, name)
        if points is not None:
            arrays[f"{name}_vertices"] = np.asarray(points.vertices, np.int32)
            arrays[f"{name}_weights"] = np.asarray(points.weights, np.float32)
    if model.quads is not None and model.uv_quads is not None:
        arrays["quads"] = np.asarray(model.quads, np.int32)
        arrays["uv_quads"] = np.asarray(model.uv_quads, np.int32)
    for name in _OCCLUSION:
        if getattr(model, name) is not None:
            arrays[name] = np.asarray(getattr(model, name), np.float16)
    broken = [k for k, v in arrays.items() if v.dtype.kind == "f" and not np.isfinite(v).all()]
    if broken:
        raise ValueError(f"model {model.name!r} has non-finite values in {broken}")
    metadata = {
        "format": "jaxface.morphable",
        "schema": SCHEMA,
        "name": model.name,
        "licence": model.licence,
        "region_names": list(model.region_names),
        "expression_names": list(model.expression_names),
        "source": source or {},
    }
    arrays["metadata"] = np.array(json.dumps(metadata))
    with atomic_path(path) as temporary:
        np.savez_compressed(temporary, **arrays)


def read_metadata(path: str | os.PathLike) -> dict:
    """The JSON metadata of a model file: name, licence, schema, how it was made.

    Raises:
        ValueError: the file is not a model file of a schema this version reads.
    """
    return _metadata(_read_arrays(path, only="metadata"), path)


def load_model(path: str | os.PathLike) -> MorphableModel:
    """Read a model written by :func:`save_model`; arrays come back as float32 and int32.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is truncated, not a model file, or its shapes disagree; the message
            names the file and the array.
    """
    arrays = _read_arrays(path)
    metadata = _metadata(arrays, path)
    _validate(arrays, metadata, path)

    def basis(name: str) -> LinearBasis:
        columns = arrays[f"{name}_steps"] * arrays[f"{name}_scale"]
        return LinearBasis(
            jnp.asarray(columns, jnp.float32), jnp.asarray(arrays[f"{name}_std"], jnp.float32)
        )

    def points(name: str) -> SurfacePoints | None:
        if f"{name}_vertices" not in arrays:
            return None
        return SurfacePoints(
            jnp.asarray(arrays[f"{name}_vertices"], jnp.int32),
            jnp.asarray(arrays[f"{name}_weights"], jnp.float32),
        )

    has_quads = "quads" in arrays
    return MorphableModel(
        mean=jnp.asarray(arrays["mean"], jnp.float32),
        identity=basis("identity"),
        expression=basis("expression"),
        albedo_mean=jnp.asarray(arrays["albedo_mean"], jnp.float32),
        albedo=basis("albedo"),
        faces=jnp.asarray(arrays["faces"], jnp.int32),
        uv=jnp.asarray(arrays["uv"], jnp.float32),
        uv_faces=jnp.asarray(arrays["uv_faces"], jnp.int32),
        landmarks68=points("landmarks68"),
        landmarks468=points("landmarks468"),
        region=jnp.asarray(arrays["region"], jnp.int32),
        name=metadata["name"],
        region_names=tuple(metadata["region_names"]),
        expression_names=tuple(metadata["expression_names"]),
        licence=metadata["licence"],
        quads=jnp.asarray(arrays["quads"], jnp.int32) if has_quads else None,
        uv_quads=jnp.asarray(arrays["uv_quads"], jnp.int32) if has_quads else None,
        **{name: jnp.asarray(arrays[name], jnp.float32) for name in _OCCLUSION if name in arrays},
    )


def _quantise(basis: np.ndarray, finest: float) -> tuple[np.ndarray, np.ndarray]:
    """int16 steps (n, 3, k) and the size of a step in each column (k,) float32."""
    if not np.isfinite(basis).all():
        raise ValueError("a basis to be saved has non-finite values")
    largest = np.abs(basis).max((0, 1), initial=0.0)
    scale = np.maximum(largest / 32767, finest).astype(np.float32)
    return np.round(basis / scale.astype(np.float64)).clip(-32767, 32767).astype(np.int16), scale


def _read_arrays(path: str | os.PathLike, only: str | None = None) -> dict[str, np.ndarray]:
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no model file {str(path)!r}")
    try:
        # Opened here, for NumPy leaves a file open when its zip directory is broken.
        with open(path, "rb") as stream:
            stored = np.load(stream, allow_pickle=False)
            if not isinstance(stored, np.lib.npyio.NpzFile):
                raise ValueError("it is a single array, not an .npz")
            names = stored.files if only is None else [only] if only in stored.files else []
            return {name: stored[name] for name in names}
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, ValueError) as error:
        raise ValueError(
            f"{str(path)!r} is not a readable model file (truncated or another format): {error}"
        ) from error


def _metadata(arrays: dict[str, np.ndarray], path: str | os.PathLike) -> dict:
    if "metadata" not in arrays:
        raise ValueError(f"{str(path)!r} is an .npz without 'metadata': not a jaxface model")
    try:
        metadata = json.loads(str(arrays["metadata"]))
    except json.JSONDecodeError as error:
        raise ValueError(f"{str(path)!r}: its metadata is not JSON: {error}") from error
    if not isinstance(metadata, dict) or metadata.get("format") != "jaxface.morphable":
        raise ValueError(f"{str(path)!r} is not a jaxface morphable model")
    if metadata.get("schema") != SCHEMA:
        raise ValueError(
            f"{str(path)!r} has schema {metadata.get('schema')!r}; this version reads {SCHEMA}"
        )
    return metadata


def _is_model(entry) -> bool:
    with resources.as_file(entry) as path:
        try:
            read_metadata(path)
        except ValueError:
            return False
    return True


def _validate(arrays: dict[str, np.ndarray], metadata: dict, path: str | os.PathLike) -> None:
    """Raise ValueError unless every array is there, of the right shape, with indices in range."""

    def need(good: bool, what: str) -> None:
        if not good:
            raise ValueError(f"{str(path)!r}: {what}")

    def expect(name: str, shape: tuple[int | None, ...]) -> np.ndarray:
        need(name in arrays, f"array {name!r} is missing")
        array = arrays[name]
        fits = array.ndim == len(shape) and all(
            w is None or g == w for g, w in zip(array.shape, shape, strict=True)
        )
        wanted = tuple("any" if size is None else size for size in shape)
        need(fits, f"array {name!r} has shape {array.shape}, needs {wanted}")
        return array

    def expect_index(name: str, shape: tuple[int | None, ...], count: int, low: int = 0) -> None:
        array = expect(name, shape)
        need(
            array.dtype.kind in "iu"
            and (array.size == 0 or (array.min() >= low and array.max() < count)),
            f"array {name!r} must hold integers in [{low}, {count})",
        )

    for key, kind in {
        "name": str,
        "licence": str,
        "region_names": list,
        "expression_names": list,
    }.items():
        need(isinstance(metadata.get(key), kind), f"metadata {key!r} is not a {kind.__name__}")
    count = len(expect("mean", (None, 3)))
    expect("albedo_mean", (count, 3))
    for name in _BASES:
        modes = expect(f"{name}_steps", (count, 3, None)).shape[-1]
        expect(f"{name}_scale", (modes,))
        expect(f"{name}_std", (modes,))
    named = len(metadata["expression_names"])
    modes = arrays["expression_std"].size
    need(modes == named, f"{modes} expression modes but {named} expression names")
    expect_index("faces", (None, 3), count)
    corners = len(expect("uv", (None, 2)))
    expect_index("uv_faces", (len(arrays["faces"]), 3), corners)
    expect_index("region", (count,), len(metadata["region_names"]))
    if "quads" in arrays or "uv_quads" in arrays:
        expect_index("quads", (None, 4), count, low=-1)
        expect_index("uv_quads", (len(arrays["quads"]), 4), corners, low=-1)
    for name, shape in _OCCLUSION.items():
        if name in arrays:
            expect(name, (count, *shape))
    for name, points in _LANDMARKS.items():
        if f"{name}_vertices" in arrays:
            expect_index(f"{name}_vertices", (points, 3), count)
            expect(f"{name}_weights", (points, 3))
