"""ICT-FaceKit: its folder of OBJ files, and one ``.npz`` with the same content.

Li et al., "Learning Formation of Physically-Based Face Attributes", CVPR 2020. Units centimetres,
+y up, +z forward. The kit's light model has 26,719 vertices in twelve materials, 100 identity and
53 expression shapes, each a mesh of its own; identity shapes stand one standard deviation from
the neutral mesh. It has no albedo: a generic skin is put on, and teeth and eyes are painted.
"""

import json
from pathlib import Path

import numpy as np

from jaxface._types import Float, Int
from jaxface.io.face_models.assemble import (
    BLENDSHAPE_STD,
    ModelFormatError,
    Modes,
    SourceModel,
    assemble,
    require,
)
from jaxface.io.face_models.landmarks import vertex_points
from jaxface.io.face_models.skin import generic_skin, paint_parts
from jaxface.io.formats.obj import read_obj, read_obj_vertices, triangles
from jaxface.io.formats.restricted_pickle import load_npz
from jaxface.models.morphable import MorphableModel
from jaxface.models.regions import REGIONS, label_regions

_LICENCE = "ICT-FaceKit, MIT licence, (c) 2020 USC Institute for Creative Technologies"
_MILLIMETRES = 10.0
_NEUTRAL = "generic_neutral_mesh"

PARTS = {
    "face": "M_Face",
    "head": "M_BackHead",
    "gums": "M_GumsTongue",
    "teeth": "M_Teeth",
    "left_eye": "M_ScleraLeft",
    "right_eye": "M_ScleraRight",
}
"""part -> the kit's material. Left out are the transparent layers over the eyes (fluid,
blend, occlusion, lashes) and the irises, which lie inside the opaque eyeballs."""

_TILES = {
    "M_Face": (0.0, 0.25, 0.75, 0.75),
    "M_BackHead": (0.75, 0.25, 0.25, 0.75),
    "M_GumsTongue": (0.0, 0.0, 0.25, 0.25),
    "M_Teeth": (0.25, 0.0, 0.25, 0.25),
    "M_ScleraLeft": (0.5, 0.0, 0.25, 0.25),
    "M_ScleraRight": (0.75, 0.0, 0.25, 0.25),
}
"""left, bottom, width and height in the one texture of each material's unit tile"""


def load_ict(path: str | Path, *, parts: tuple[str, ...] = tuple(PARTS)) -> MorphableModel:
    """Load the kit from its folder (``FaceXModel``) or from an ``.npz``.

    The kit gives every material a UV tile of its own; here they share one texture: the face at
    0.75 of full size in the upper left, the back of the head beside it (narrowed to a third),
    and gums, teeth and eyeballs in a row below.

    Args:
        path: a folder with ``generic_neutral_mesh.obj``, ``identityNNN.obj``, the expressions and
            ``vertex_indices.json``; or an npz with ``mean``, ``quads``, ``uv``, ``uv_quads``,
            ``face_material``, ``materials``, ``id_modes``, ``id_scale``, ``ex_modes``,
            ``ex_scale``, ``ex_names``, ``landmarks68`` and ``units``.
        parts: which of `PARTS` to keep, for the folder; landmarks need "face" and "head".

    Raises:
        ValueError: a file is missing or malformed, or a part is unknown; names the file.
    """
    path = Path(path)
    unknown = [part for part in parts if part not in PARTS]
    if unknown or not parts:
        raise ValueError(f"parts {unknown or parts} are none of {list(PARTS)}")
    return _from_folder(path, parts) if path.is_dir() else _from_npz(path, parts)


def _from_folder(folder: Path, parts: tuple[str, ...]) -> MorphableModel:
    neutral_path = folder / f"{_NEUTRAL}.obj"
    if not neutral_path.is_file():
        raise ModelFormatError(
            folder, f"no {_NEUTRAL}.obj", "the kit's FaceXModel folder, with its neutral mesh"
        )
    mesh = read_obj(neutral_path)
    indices_path = folder / "vertex_indices.json"
    expressions, landmarks = _indices(indices_path)
    identities = sorted(folder.glob("identity*.obj"))
    require(
        bool(identities), folder, "no identity*.obj", "the identity shapes beside the neutral mesh"
    )
    present = [name for name in expressions if (folder / f"{name}.obj").is_file()]
    shapes = [folder / f"{name}.obj" for name in present]
    count = len(mesh.vertices)
    deltas = [read_obj_vertices(file, count) - mesh.vertices for file in [*identities, *shapes]]
    if mesh.uv is None or mesh.uv_polygons is None:
        raise ModelFormatError(neutral_path, "no texture coordinates", "the kit's UV tiles")
    return _build(
        folder,
        mesh.vertices,
        (mesh.polygons, mesh.uv, mesh.uv_polygons),
        np.array([mesh.materials[i] for i in mesh.material]),
        np.stack(deltas, axis=-1),
        len(identities),
        tuple(present),
        landmarks,
        parts,
        _MILLIMETRES,
    )


def _from_npz(path: Path, parts: tuple[str, ...]) -> MorphableModel:
    content = load_npz(path)
    needed = ("mean", "quads", "uv", "uv_quads", "face_material", "materials", "landmarks68")
    needed += ("id_modes", "id_scale", "ex_modes", "ex_scale", "ex_names", "units")
    missing = [key for key in needed if key not in content]
    require(not missing, path, f"arrays {sorted(content)}", f"also {missing}")
    units = str(content["units"])
    scale = {"mm": 1.0, "cm": 10.0, "m": 1000.0}.get(units)
    if scale is None:
        raise ModelFormatError(path, f"units {units!r}", "mm, cm or m")
    count = len(content["mean"])
    groups = []
    for modes, factor in (("id_modes", "id_scale"), ("ex_modes", "ex_scale")):
        shape, factors = content[modes].shape, content[factor]
        require(
            shape[1:] == (count, 3) and factors.shape == shape[:1],
            path,
            f"{modes} of shape {shape} with {factors.shape} scales",
            f"(k, {count}, 3) with k",
        )
        groups.append(content[modes].astype(np.float64) * factors[:, None, None])
    names = tuple(str(name) for name in content["ex_names"])
    materials = np.asarray(content["materials"])[content["face_material"]]
    return _build(
        path,
        content["mean"].astype(np.float64),
        (content["quads"], content["uv"].astype(np.float64), content["uv_quads"]),
        materials,
        np.moveaxis(np.concatenate(groups), 0, -1),
        len(groups[0]),
        names,
        content["landmarks68"],
        parts,
        scale,
    )


def _build(
    path: Path,
    vertices: Float[np.ndarray, "n 3"],
    topology: tuple[np.ndarray, np.ndarray, np.ndarray],
    materials: np.ndarray,
    deltas: Float[np.ndarray, "n 3 k"],
    identity_count: int,
    expression_names: tuple[str, ...],
    landmarks: Int[np.ndarray, "68"],
    parts: tuple[str, ...],
    scale: float,
) -> MorphableModel:
    polygons, uv, uv_polygons = topology
    names = [part for part in PARTS if part in parts and np.any(materials == PARTS[part])]
    wanted = [PARTS[part] for part in names]
    chosen = np.isin(materials, wanted)
    require(bool(chosen.any()), path, f"materials {sorted(set(materials))}", f"one of {wanted}")
    polygons, uv_polygons, materials = polygons[chosen], uv_polygons[chosen], materials[chosen]
    require(
        polygons.shape[1:] == (4,)
        and polygons.shape == uv_polygons.shape
        and 0 <= polygons[:, :3].min()
        and polygons.max() < len(vertices)
        and 0 <= uv_polygons[:, :3].min()
        and uv_polygons.max() < len(uv),
        path,
        f"quads {polygons.shape} and texture quads {uv_polygons.shape}",
        f"(q, 4) within {len(vertices)} vertices and {len(uv)} coordinates",
    )
    kept, renumber = _compact(polygons, len(vertices))
    require(
        landmarks.shape == (68,) and 0 <= landmarks.min() and landmarks.max() < len(vertices),
        path,
        f"landmarks of shape {landmarks.shape}",
        f"68 vertices of {len(vertices)}",
    )
    quads = np.where(polygons >= 0, renumber[polygons], -1).astype(np.int32)
    landmarks = renumber[landmarks]
    kept_uv, renumber_uv = _compact(uv_polygons, len(uv))
    uv_quads = np.where(uv_polygons >= 0, renumber_uv[uv_polygons], -1).astype(np.int32)
    is_quad = quads[:, 3] >= 0
    part = np.zeros(len(kept), np.int32)
    for index in reversed(range(len(names))):  # a vertex on a border counts to the first part
        of_part = quads[materials == wanted[index]]
        part[np.unique(of_part[of_part >= 0])] = index
    mean, deltas = vertices[kept] * scale, deltas[kept] * scale
    located = bool(np.all(landmarks >= 0))
    points = mean[landmarks] if located else None
    albedo_mean, albedo, std = generic_skin(mean, points)
    albedo_mean, albedo = paint_parts(mean, part, tuple(names), albedo_mean, albedo)
    region, region_names = part, tuple(names)
    if points is not None:
        region, region_names = _regions(mean, triangles(quads), points, part, names), REGIONS
    expressions = deltas.shape[-1] - identity_count
    return assemble(
        SourceModel(
            path=path,
            name="ict",
            licence=_LICENCE,
            mean=mean,
            faces=triangles(quads),
            identity=Modes(deltas[..., :identity_count], np.ones(identity_count)),
            expression=Modes(
                deltas[..., identity_count:] * BLENDSHAPE_STD, np.full(expressions, BLENDSHAPE_STD)
            ),
            expression_names=expression_names,
            albedo_mean=albedo_mean,
            albedo=Modes(albedo, std),
            uv=_one_texture(uv, uv_polygons, materials)[kept_uv],
            uv_faces=triangles(uv_quads, is_quad),
            quads=quads,
            uv_quads=uv_quads,
            landmarks68=vertex_points(landmarks) if located else None,
            region=region,
            region_names=region_names,
        )
    )


def _regions(
    mean: np.ndarray, faces: np.ndarray, points: np.ndarray, part: np.ndarray, names: list[str]
) -> np.ndarray:
    """Labels from the landmarks, corrected by what the kit's materials are known to be."""
    region = label_regions(mean, faces, points)
    for index, name in enumerate(names):
        inside = part == index
        if name == "head":  # its socket of the mouth lies behind the face, that of the eye too
            outside = [REGIONS.index(r) for r in ("scalp", "neck", "eyelids")]
            region[inside & ~np.isin(region, outside)] = REGIONS.index("mouth_interior")
        elif name != "face":
            region[inside] = REGIONS.index("eyes" if name.endswith("_eye") else "mouth_interior")
    return region


def _compact(polygons: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The indices in use, and the new number of each old one (-1 where unused)."""
    used = np.unique(polygons[polygons >= 0])
    renumber = np.full(count, -1, np.int32)
    renumber[used] = np.arange(len(used), dtype=np.int32)
    return used, renumber


def _one_texture(
    uv: Float[np.ndarray, "m 2"], uv_polygons: Int[np.ndarray, "q 4"], materials: np.ndarray
) -> Float[np.ndarray, "m 2"]:
    """Move every material's UV tile to its place in the one texture (see `_TILES`)."""
    moved = uv.copy()
    for material, (left, bottom, width, height) in _TILES.items():
        table = uv_polygons[materials == material]
        corners = np.unique(table[table >= 0])
        # The integer part of u is the number of the kit's tile.
        tile = np.floor(uv[corners, 0].min()) if len(corners) else 0.0
        moved[corners, 0] = left + width * (uv[corners, 0] - tile)
        moved[corners, 1] = bottom + height * uv[corners, 1]
    return moved


def _indices(path: Path) -> tuple[list[str], np.ndarray]:
    """Expression names and landmark vertices of ``vertex_indices.json``."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        names = [str(name) for name in content["expressions"]]
        return names, np.asarray(content["idx_to_landmark_verts"], np.int64)
    except FileNotFoundError as error:
        raise ModelFormatError(path, "no such file", "the kit's vertex_indices.json") from error
    except (json.JSONDecodeError, KeyError, TypeError, ValueError) as error:
        raise ModelFormatError(
            path, f"{error!r}", "JSON with expressions and idx_to_landmark_verts"
        ) from error
