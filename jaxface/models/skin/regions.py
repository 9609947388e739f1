"""Where on a face which skin lies: smooth weights per vertex, directions, and texel size.

Everything is in the frame of the model's mean face (mm), placed by its 68 landmarks.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Float, Int
from jaxface.geometry.mesh import vertex_neighbours, vertex_normals
from jaxface.imaging.colour import LUMINANCE
from jaxface.imaging.masks import smoothstep
from jaxface.models.morphable import MorphableModel
from jaxface.models.opening_rims import OpeningRims, opening_rims
from jaxface.models.regions import NOT_SKIN

RIM_RINGS = 5
"""rings of vertices inside the mouth that are lip"""


class Regions(eqx.Module):
    """Weights 0 to 1 of the kinds of skin, one number a point."""

    skin: Float[Array, "n"]
    nose: Float[Array, "n"]
    cheek: Float[Array, "n"]
    forehead: Float[Array, "n"]
    lips: Float[Array, "n"]
    lid: Float[Array, "n"]
    under_eye: Float[Array, "n"]
    chin: Float[Array, "n"]
    ear: Float[Array, "n"]
    beard: Float[Array, "n"]
    brow: Float[Array, "n"]
    scalp: Float[Array, "n"]
    neck: Float[Array, "n"]


class SkinFields(eqx.Module):
    """Per-vertex quantities that a procedural skin interpolates; vectors are rows of three."""

    position: Float[Array, "n 3"]
    normal: Float[Array, "n 3"]
    tension: Float[Array, "n 3"]
    """unit vectors along the lines of relaxed skin tension (sign means nothing)"""
    hair: Float[Array, "n 3"]
    """unit vectors along which beard hair grows"""
    regions: Regions
    spacing: Float[Array, "n"]
    """mm per unit of UV, the geometric mean over directions"""
    landmarks: Float[Array, "68 3"]
    rims: OpeningRims
    """of eyes and mouth"""


def skin_fields(model: MorphableModel) -> SkinFields:
    """The fields of a model's mean face.

    Raises:
        ValueError: the model has no 68 landmarks.
    """
    if model.landmarks68 is None:
        raise ValueError(
            f"model {model.name!r} has no 68 landmarks; procedural skin needs them to know where "
            "nose, cheeks and lips lie (run `jaxface model embed-landmarks`)"
        )
    position = np.asarray(model.mean, np.float64)
    marks = np.asarray(model.landmarks68(model.mean), np.float64)
    normal = np.asarray(vertex_normals(model.mean, model.faces), np.float64)
    neighbours = vertex_neighbours(np.asarray(model.faces), len(position))
    regions = _regions(model, position, marks, neighbours)
    tension = _tangent(_tension(position, marks), normal)
    down = np.stack([0.25 * np.tanh(position[:, 0] / 20), -np.ones(len(position)),
                     0.15 * np.ones(len(position))], axis=1)  # fmt: skip
    return SkinFields(
        position=jnp.asarray(position, jnp.float32),
        normal=jnp.asarray(normal, jnp.float32),
        tension=jnp.asarray(tension, jnp.float32),
        hair=jnp.asarray(_tangent(down, normal), jnp.float32),
        regions=Regions(**{k: jnp.asarray(v, jnp.float32) for k, v in regions.items()}),
        spacing=jnp.asarray(_spacing(model, position), jnp.float32),
        landmarks=jnp.asarray(marks, jnp.float32),
        rims=opening_rims(model),
    )


def _regions(
    model: MorphableModel,
    position: np.ndarray,
    marks: np.ndarray,
    neighbours: Int[np.ndarray, "n v"],
) -> dict[str, np.ndarray]:
    def named(*names: str, passes: int) -> np.ndarray:
        known = [name for name in names if name in model.region_names]
        if not known:
            return np.zeros(len(position))
        mask = np.asarray(model.region_mask(*known), np.float64)
        return _smooth(mask, neighbours, passes)

    # The lips go on a little way into the mouth.
    interior, rim = named("mouth_interior", passes=0), named("lips", passes=0)
    for _ in range(RIM_RINGS):
        rim = np.maximum(rim, interior * (_smooth(rim, neighbours, 1) > 0))

    x, y, z = position.T
    front = smoothstep(z, marks[0, 2], marks[0, 2] + 30)
    skin = np.maximum(1 - named(*NOT_SKIN, passes=0), rim)
    lips = _smooth(rim, neighbours, 2)
    lid = named("eyelids", passes=2) * skin
    eye = 0.5 * (marks[36:42].mean(0) + marks[42:48].mean(0))
    nose = np.maximum(
        _near(position, _polyline(marks[28:31]), 10.0),
        _near(position, _polyline(marks[31:36] + [0, 4, 0]), 9.0),
    )
    cheeks, under = [], []
    for lower, corner, jaw, side in ((41, 48, 2, -1), (46, 54, 14, 1)):
        middle = 0.45 * marks[lower] + 0.25 * marks[corner] + 0.3 * marks[jaw]
        cheeks.append(_near(position, middle[None], 20.0))
        below = marks[40:42] if side < 0 else marks[46:48]
        under.append(_near(position, _polyline(below + [2.0 * side, -7.0, 0]), 5.5))
    forehead = (
        front * smoothstep(y, marks[19, 1] + 2, marks[19, 1] + 12) * (1 - smoothstep(y, 58, 80))
    )
    jaw_line = _polyline(marks[1:16])
    # The beard's upper border runs from the ear lobe to the corner of the mouth.
    border = marks[3, 1] + (np.abs(x) / abs(marks[3, 0])) ** 2 * (marks[1, 1] - marks[3, 1])
    beard = _near(position, jaw_line, 26.0) * (1 - smoothstep(y, border - 8, border + 10))
    throat = smoothstep(y, marks[8, 1] - 45, marks[8, 1] - 15)
    moustache = _near(
        position, _polyline(0.55 * marks[31:36] + 0.45 * marks[[49, 50, 51, 52, 53]]), 6.0
    )
    around = _near(
        position, _polyline(np.concatenate([marks[54:60], marks[[48]]]) + [0, -7, 0]), 9.0
    )
    beard = np.maximum.reduce([beard * throat, moustache, 0.8 * around]) * (1 - lips) * front
    brow = np.maximum(*(_near(position, _polyline(marks[a : a + 5]), 4.5) for a in (17, 22)))
    brow = _where_dark(np.asarray(model.albedo_mean, np.float64), brow, forehead)
    out = {
        "skin": skin,
        "nose": nose,
        "cheek": np.maximum(*cheeks),
        "forehead": forehead,
        "lips": lips,
        "lid": lid * _near(position, eye[None], 60.0),
        "under_eye": np.maximum(*under),
        "chin": _near(position, (0.6 * marks[8] + 0.4 * marks[57])[None], 14.0),
        "ear": named("ears", passes=2),
        "beard": beard,
        "brow": brow,
        "scalp": named("scalp", passes=4),
        "neck": named("neck", passes=4),
    }
    return {
        name: np.clip(weight * skin if name != "skin" else weight, 0, 1)
        for name, weight in out.items()
    }


def _where_dark(albedo: np.ndarray, window: np.ndarray, around: np.ndarray) -> np.ndarray:
    """The part of a window that a model paints darker than its surroundings, if it does."""
    luma = albedo @ LUMINANCE
    darkness = 1 - luma * around.sum() / max(around @ luma, 1e-9)
    deepest = np.max(darkness * (window > 0.5), initial=0.0)
    if deepest < 0.15:
        return window
    return np.sqrt(window) * smoothstep(darkness / deepest, 0.1, 0.8)


def _tension(position: np.ndarray, marks: np.ndarray) -> np.ndarray:
    """Axes of relaxed skin tension (Borges 1984), as vectors in the frontal plane.

    Across the forehead, around eyes and mouth, and from the nose down and outwards over the cheek.
    Axes have no sign, so they are blended by their doubled angles.
    """
    offset = position[:, :2]
    side = np.sign(offset[:, 0])
    angle = [(np.zeros(len(offset)), smoothstep(position[:, 1], 15, 30) + 0.05)]
    for eye in (marks[36:42].mean(0), marks[42:48].mean(0)):
        away = offset - eye[:2]
        around = np.arctan2(away[:, 1], away[:, 0]) + np.pi / 2
        angle.append((around, 2 * np.exp(-0.5 * np.sum((away / [22, 16]) ** 2, axis=1))))
    mouth = offset - marks[48:60].mean(0)[:2]
    angle.append((np.arctan2(mouth[:, 1] / 0.6, mouth[:, 0]) + np.pi / 2,
                  1.2 * np.exp(-0.5 * np.sum((mouth / [26, 18]) ** 2, axis=1))))  # fmt: skip
    cheek = np.arctan2(-0.85 * np.ones(len(side)), 0.5 * side)
    angle.append((cheek, 0.5 * (1 - smoothstep(position[:, 1], -15, 10))))
    axes = [w[:, None] * np.stack([np.cos(2 * a), np.sin(2 * a)], axis=1) for a, w in angle]
    axis = np.sum(axes, axis=0)
    half = 0.5 * np.arctan2(axis[:, 1], axis[:, 0])
    return np.stack([np.cos(half), np.sin(half), np.zeros(len(half))], axis=1)


def _tangent(vector: np.ndarray, normal: np.ndarray) -> np.ndarray:
    vector = vector - np.sum(vector * normal, axis=1, keepdims=True) * normal
    return vector / np.maximum(np.linalg.norm(vector, axis=1, keepdims=True), 1e-6)


def _spacing(model: MorphableModel, position: np.ndarray) -> np.ndarray:
    """Square root of surface area over UV area around each vertex."""
    faces, uv = (
        np.asarray(model.faces),
        np.asarray(model.uv, np.float64)[np.asarray(model.uv_faces)],
    )
    corner = position[faces]
    area = np.linalg.norm(
        np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1
    )
    b, c = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    flat = np.abs(b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
    count = len(position)
    surface = np.bincount(faces.ravel(), np.repeat(area, 3), count)
    texture = np.bincount(faces.ravel(), np.repeat(flat, 3), count)
    return np.sqrt(surface / np.maximum(texture, 1e-12))


def _near(position: np.ndarray, points: np.ndarray, width: float) -> np.ndarray:
    """Gaussian of the distance to the nearest of some points (mm)."""
    squared = np.min(np.sum((position[:, None] - points[None]) ** 2, axis=2), axis=1)
    return np.exp(-0.5 * squared / width**2)


def _polyline(points: np.ndarray, each: int = 4) -> np.ndarray:
    share = np.arange(each)[:, None, None] / each
    between = (points[None, :-1] * (1 - share) + points[None, 1:] * share).reshape(-1, 3)
    return np.concatenate([between, points[-1:]])


def _smooth(values: np.ndarray, neighbours: np.ndarray, passes: int) -> np.ndarray:
    present = neighbours >= 0
    for _ in range(passes):
        total = np.sum(np.where(present, values[np.maximum(neighbours, 0)], 0), axis=1)
        values = 0.5 * values + 0.5 * total / np.maximum(present.sum(axis=1), 1)
    return values
