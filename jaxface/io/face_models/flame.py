"""FLAME (``.pkl`` or ``.npz``), its skinned joints turned into linear expression modes.

Li et al., "Learning a model of facial shape and expression from 4D scans", SIGGRAPH Asia 2017.
Units metres, +y up, +z forward; shape coefficients already count standard deviations.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxface._types import Float, Int
from jaxface.io.face_models.assemble import Modes, SourceModel, assemble, require
from jaxface.io.face_models.landmarks import read_landmarks68
from jaxface.io.formats.restricted_pickle import load_npz, load_pickle
from jaxface.models.morphable import MorphableModel

_LICENCE = "FLAME, Max Planck Institute for Intelligent Systems: licensed to its holder"
_MILLIMETRES = 1000.0
_KEYS = ("v_template", "f", "shapedirs", "weights", "J_regressor", "kintree_table", "posedirs")

JOINT_MODES = (
    ("jawOpen", 2, (1.0, 0.0, 0.0), 0.1),
    ("jawLeft", 2, (0.0, 1.0, 0.0), 0.03),
)
"""name, joint, axis and standard deviation (radians) of each linearised rotation"""

NECK_MODES = (
    ("neckPitch", 1, (1.0, 0.0, 0.0), 0.15),
    ("neckYaw", 1, (0.0, 1.0, 0.0), 0.15),
    ("neckRoll", 1, (0.0, 0.0, 1.0), 0.1),
)


def load_flame(
    path: str | Path,
    *,
    landmarks: str | Path | Sequence[str | Path] | None = None,
    identity_count: int | None = None,
    neck: bool = False,
) -> MorphableModel:
    """Load FLAME 2017, 2019, 2020 or 2023 as a linear model.

    ``shapedirs`` holds identity, then 100 expressions (300 + 100 since 2019). Rotations of the
    jaw join the expressions as their derivative at the closed mouth (`joint_derivative`), one
    standard deviation 0.1 rad; a rotation by ``t`` is then wrong by ``r t^2 / 2`` at distance
    ``r`` from the joint: 2% of ``r`` at 0.2 rad, which moves it by 20% of ``r``. FLAME stores no
    albedo and no landmarks: a generic skin is put on, and ``landmarks`` takes its embeddings.

    Args:
        path: ``generic_model.pkl`` or the like; pickles are read without running them.
        landmarks: the 68 points, e.g. (``flame_static_embedding.pkl``,
            ``flame_dynamic_embedding.npy``), or any other form `read_landmarks68` knows.
        identity_count: how many of ``shapedirs`` are identity; all but the last 100 by default.
        neck: add the neck's rotations too.

    Raises:
        ValueError: not such a file, or its parts disagree.
    """
    path = Path(path)
    content = load_npz(path) if path.suffix.lower() == ".npz" else load_pickle(path)
    require(isinstance(content, dict), path, f"a {type(content).__name__}", "FLAME's dictionary")
    content = {str(key): value for key, value in content.items()}
    missing = [key for key in _KEYS if key not in content]
    require(not missing, path, f"entries {sorted(content)}", f"also {missing}")
    template = _numbers(path, content, "v_template", (None, 3))
    count = len(template)
    faces = _numbers(path, content, "f", (None, 3)).astype(np.int64).astype(np.int32)
    directions = _numbers(path, content, "shapedirs", (count, 3, None))
    total = directions.shape[2]
    split = max(total - 100, 0) if identity_count is None else identity_count
    require(0 <= split <= total, path, f"{total} shape directions", f"at least {split}")

    modes = [directions[:, :, split:]]
    names = [f"expression{i:03d}" for i in range(total - split)]
    std = [np.ones(total - split)]
    rig = _rig(path, content, template)
    for name, joint, axis, angle in JOINT_MODES + (NECK_MODES if neck else ()):
        if joint < rig["joints"]:
            slope = joint_derivative(template, joint=joint, axis=np.array(axis), **rig["arrays"])
            modes.append(angle * slope[..., None])
            names.append(name)
            std.append(np.array([angle]))
    expression = np.concatenate(modes, axis=2)
    return assemble(
        SourceModel(
            path=path,
            name=path.stem if "flame" in path.stem.lower() else f"flame-{path.stem}",
            licence=_LICENCE,
            mean=template * _MILLIMETRES,
            faces=faces,
            identity=Modes(directions[:, :, :split] * _MILLIMETRES, np.ones(split)),
            expression=Modes(expression * _MILLIMETRES, np.concatenate(std)),
            expression_names=tuple(names),
            uv=_optional(content, "vt"),
            uv_faces=_optional(content, "ft", np.int32),
            landmarks68=read_landmarks68(landmarks, faces, count),
        )
    )


def joint_derivative(
    template: Float[np.ndarray, "n 3"],
    *,
    joint: int,
    axis: Float[np.ndarray, "3"],
    weights: Float[np.ndarray, "n j"],
    regressor: Float[np.ndarray, "j n"],
    posedirs: Float[np.ndarray, "n 3 p"],
    parents: Int[np.ndarray, "j"],
) -> Float[np.ndarray, "n 3"]:
    """Derivative of the skinned template with respect to a joint's angle, at the rest pose.

    Linear blend skinning with pose correctives moves a vertex, to first order in the angle ``t``
    about ``axis`` through the joint ``J``, by ``t (w axis x (v - J) + P vec([axis]x))``: ``w`` is
    its weight on the joint and everything that hangs on it, ``P`` the joint's nine correctives
    (Li 2017, eq. 2 and 4; the correctives multiply ``R - I``, row by row).
    """
    children = {joint}
    for index, parent in enumerate(parents):
        if int(parent) in children and index != joint:
            children.add(index)
    weight = weights[:, sorted(children)].sum(axis=1)
    centre = regressor[joint] @ template
    slope = weight[:, None] * np.cross(axis, template - centre)
    x, y, z = axis
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    correctives = posedirs[:, :, 9 * (joint - 1) : 9 * joint]
    if correctives.shape[2] == 9:
        slope = slope + correctives @ skew.ravel()
    return slope


def _rig(path: Path, content: dict[str, Any], template: np.ndarray) -> dict[str, Any]:
    count = len(template)
    weights = _numbers(path, content, "weights", (count, None))
    joints = weights.shape[1]
    tree = _numbers(path, content, "kintree_table", (2, joints))
    parents = tree[0].astype(np.uint32).astype(np.int32)  # the root's parent is 2^32 - 1
    posedirs = np.asarray(content["posedirs"], np.float64)
    if posedirs.ndim == 2 and posedirs.shape[1] == 3 * count:
        posedirs = posedirs.T.reshape(count, 3, -1)
    require(
        posedirs.ndim == 3 and posedirs.shape[:2] == (count, 3),
        path,
        f"posedirs of shape {posedirs.shape}",
        f"({count}, 3, 9 (j - 1))",
    )
    arrays = {
        "weights": weights,
        "regressor": _numbers(path, content, "J_regressor", (joints, count)),
        "posedirs": posedirs,
        "parents": parents,
    }
    return {"joints": joints, "arrays": arrays}


def _numbers(
    path: Path, content: dict[str, Any], key: str, shape: tuple[int | None, ...]
) -> np.ndarray:
    values = np.asarray(content[key])
    fits = values.dtype.kind in "fiu" and values.ndim == len(shape)
    fits = fits and all(w is None or h == w for h, w in zip(values.shape, shape, strict=True))
    require(
        fits,
        path,
        f"{key} of shape {values.shape} and type {values.dtype}",
        f"numbers of shape {tuple('any' if w is None else w for w in shape)}",
    )
    return values.astype(np.float64)


def _optional(content: dict[str, Any], key: str, dtype: type = np.float64) -> np.ndarray | None:
    return np.asarray(content[key]).astype(dtype) if key in content else None
