"""``fit.npz``: everything a fit found, in plain arrays and one JSON string."""

import json
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxface._types import Float
from jaxface.io.atomic import atomic_path
from jaxface.models.parameters import FaceParameters

SCHEMA = 1
_PARAMETERS = tuple(FaceParameters.__dataclass_fields__)


class SavedFit(NamedTuple):
    """A fit as read back.

    Attributes:
        parameters: coefficients, pose, camera, light.
        arrays: the other arrays by name (landmarks, masks, vertex deviations, crop ...).
        metadata: model name, energies, schema, units.
    """

    parameters: FaceParameters
    arrays: dict[str, Float[np.ndarray, "..."]]
    metadata: dict[str, Any]


def write_fit(
    path: str | os.PathLike[str],
    parameters: FaceParameters,
    arrays: Mapping[str, np.ndarray],
    metadata: Mapping[str, Any],
) -> None:
    """Write a fit, whole or not at all.

    Args:
        path: the ``.npz``.
        parameters: stored under the names of their fields, coefficients in standard deviations.
        arrays: further arrays by name.
        metadata: JSON-able facts; the schema version is added.

    Raises:
        ValueError: an array has the name of a parameter.
    """
    clash = sorted(set(arrays) & {*_PARAMETERS, "metadata"})
    if clash:
        raise ValueError(f"arrays {clash} carry names of the fit's own parameters")
    own = {name: np.asarray(getattr(parameters, name)) for name in _PARAMETERS}
    text = json.dumps({"schema": SCHEMA, **metadata})
    entries: dict[str, Any] = {**own, **arrays, "metadata": np.array(text)}
    with atomic_path(Path(path)) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **entries)


def read_fit(path: str | os.PathLike[str]) -> SavedFit:
    """Read what ``write_fit`` wrote.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: not a fit, a damaged file, or one of a newer schema.
    """
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
    except FileNotFoundError:
        raise
    except (zipfile.BadZipFile, ValueError, OSError, EOFError) as error:
        raise ValueError(f"{path} is not a whole .npz file: {error}") from error
    missing = [name for name in (*_PARAMETERS, "metadata") if name not in arrays]
    if missing:
        raise ValueError(f"{path} is not a fit: it lacks {missing}")
    metadata = json.loads(str(arrays.pop("metadata")))
    if metadata.get("schema") != SCHEMA:
        raise ValueError(f"{path} has schema {metadata.get('schema')}; {SCHEMA} is needed")
    parameters = FaceParameters(**{name: arrays.pop(name) for name in _PARAMETERS})
    return SavedFit(parameters, arrays, metadata)
