"""Fitted face -> files: mesh, texture, arrays, pictures and report."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxface.geometry.rotation import euler_yxz, rotation_matrix
from jaxface.io.atomic import atomic_path
from jaxface.io.fit_file import write_fit
from jaxface.io.formats.exr import srgb_encoded, write_exr
from jaxface.io.formats.gltf import GlbCamera, write_glb
from jaxface.io.formats.image import write_png
from jaxface.io.formats.obj import write_obj
from jaxface.io.pictures.fit_sheet import fit_sheet
from jaxface.io.pictures.report import write_report
from jaxface.models.morphable import MorphableModel
from jaxface.pipeline.fitting.fitted_face import FittedFace
from jaxface.pipeline.fitting.partial import Texture
from jaxface.run.clock import Clock
from jaxface.run.environment import environment

_FILES = {
    "overlay.png": "photo, landmarks, render, geometry, albedo, residual, standard deviation",
    "mesh.obj": "fitted shape in the model's frame (mm), with UVs and texture",
    "mesh.glb": "the same with named expressions as morph targets and the pose on its node",
    "fit.npz": "coefficients, pose, camera, light, landmarks, masks, covariance",
    "albedo_partial.exr": "albedo that the photo shows, UV, linear half float RGB + weight",
    "albedo_partial.png": "preview of it, sRGB",
    "visibility.png": "how far each of its texels is to be trusted",
    "texture.png": "the partial albedo over the model's own, sRGB",
}


def save_fit(
    fitted: FittedFace,
    out: str | os.PathLike[str],
    *,
    textured: Texture | None = None,
    title: str = "fit",
    clock: Clock | None = None,
) -> Path:
    """Write everything a fit yields into a folder; each file whole or not at all.

    The report is written last: a folder with ``report.json`` is complete.

    Args:
        fitted: the fit.
        out: folder, made if it does not exist.
        textured: textures to write beside the mesh; without them the mesh has vertex colours.
        title: name of the photo, for the report.
        clock: that of the run so far; the report has its times.

    Returns:
        Path of the HTML report.

    Raises:
        ValueError: the fit came from a file, without its history.
    """
    clock = clock or Clock()
    fitted.estimate_posterior(clock)
    fitted.skin_map(clock)
    fitted.render(clock)
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    if textured is not None:
        clock.host("write textures", _write_textures, folder, textured)
    clock.host("write meshes", _write_meshes, folder, fitted, textured)
    clock.host("write fit", _write_arrays, folder, fitted, textured)
    clock.host("draw overlay", _write_overlay, folder, fitted, title)
    return write_report(folder, report(fitted, folder, title, clock))[0]


def _write_textures(folder: Path, textured: Texture) -> None:
    partial = textured.partial
    albedo, weight = np.asarray(partial.albedo), np.asarray(partial.weight)[..., None]
    write_exr(folder / "albedo_partial.exr", np.concatenate([albedo, weight], axis=-1), half=True)
    encoded = srgb_encoded(albedo)
    write_png(folder / "albedo_partial.png", np.where(weight > 0, encoded, 0.5))
    write_png(folder / "visibility.png", weight[..., 0])
    write_png(folder / "texture.png", srgb_encoded(np.asarray(textured.whole)))


def _write_meshes(folder: Path, fitted: FittedFace, textured: Texture | None) -> None:
    y, model = fitted.parameters, fitted.model
    vertices = np.asarray(fitted.vertices)
    uv = np.asarray(model.uv)
    polygons, corners = (model.faces, model.uv_faces)
    if model.quads is not None and model.uv_quads is not None:
        polygons, corners = model.quads, model.uv_quads
    write_obj(
        folder / "mesh.obj",
        vertices,
        np.asarray(polygons),
        uv=uv,
        uv_polygons=np.asarray(corners),
        texture=folder / "texture.png" if textured is not None else None,
        comment=f"fitted with the model {model.name} ({model.licence}); millimetres",
    )
    # The mesh at rest has the identity alone; the fitted expression is the morphs' weights.
    rest = np.asarray(model.mean + model.identity(y.identity))
    basis = np.asarray(model.expression.basis)
    deviations = np.asarray(model.expression.std)
    names = model.expression_names or tuple(f"expression{k:02d}" for k in range(basis.shape[-1]))
    morphs = {n: basis[..., k] / deviations[k] for k, n in enumerate(names)}
    standing = dict(zip(names, _expression_weights(fitted), strict=True))
    data = fitted.working.data
    picture = (folder / "texture.png").read_bytes() if textured is not None else None
    write_glb(
        folder / "mesh.glb",
        rest,
        np.asarray(model.faces),
        uv=uv,
        uv_faces=np.asarray(model.uv_faces),
        texture=picture,
        colours=None if picture else np.clip(np.asarray(model.reflectance(y.albedo)), 0, 1),
        morphs=morphs,
        weights=standing,
        pose=y.pose,
        camera=GlbCamera(float(jnp.exp(y.log_focal)) * fitted.size, fitted.size, fitted.size),
        licence=model.licence,
        extras={"model": model.name, "principal": np.asarray(data.principal).tolist()},
    )


def _expression_weights(fitted: FittedFace) -> list[float]:
    """The fitted expression in the units of the model's own shapes."""
    deviations = np.asarray(fitted.model.expression.std)
    return (np.asarray(fitted.parameters.expression) * deviations).tolist()


def _write_arrays(folder: Path, fitted: FittedFace, textured: Texture | None) -> None:
    data, crop = fitted.working.data, fitted.working.crop
    y = fitted.parameters
    camera = y.camera(data.principal, crop.side)
    arrays = {
        "landmarks": fitted.landmarks,
        "landmarks_fitted": fitted.fitted_landmarks,
        "mask": np.asarray(data.mask, np.float32),
        "skin": fitted.skin_map(),
        "crop_origin": np.asarray(crop.origin),
        "crop_side": np.asarray(crop.side),
        "focal_px": np.asarray(camera.focal),
        "principal_px": np.asarray(camera.principal) + crop.origin,
        "exposure_gain": np.asarray(fitted.working.gain),
        "covariance": np.asarray(fitted.posterior.covariance, np.float32),
        "vertex_deviation_mm": np.asarray(fitted.posterior.vertex_deviation, np.float32),
        "vertices_mm": np.asarray(fitted.vertices, np.float32),
    }
    if fitted.landmark_depth is not None:
        arrays["landmark_depth"] = np.asarray(fitted.landmark_depth, np.float32)
    if textured is not None:
        arrays["texels_per_pixel"] = np.asarray(textured.texels_per_pixel)
    metadata = {
        "model": fitted.model.name,
        "licence": fitted.model.licence,
        "coefficients": "standard deviations",
        "energies": {name: values[-1] for name, values in histories(fitted)[-1]["terms"].items()},
        "expression_names": list(fitted.model.expression_names),
        "expression_weights": _expression_weights(fitted),
    }
    write_fit(folder / "fit.npz", y, arrays, metadata)


def _write_overlay(folder: Path, fitted: FittedFace, title: str) -> None:
    rendered = fitted.render()
    data, crop = fitted.working.data, fitted.working.crop
    fragments = rendered.fragments
    triangle = np.asarray(fragments.triangle)
    covered = triangle >= 0
    corners = np.asarray(fitted.posterior.vertex_deviation)[np.asarray(fitted.model.faces)]
    deviation = np.sum(
        corners[np.maximum(triangle, 0)] * np.asarray(fragments.barycentric), axis=-1
    )
    sheet = fit_sheet(
        photo=np.asarray(data.image),
        color=np.asarray(rendered.color),
        albedo=np.asarray(rendered.albedo),
        normal=np.asarray(rendered.normal),
        covered=covered,
        skin=np.asarray(rendered.skin),
        deviation=deviation,
        detected=crop.to_crop(fitted.landmarks) * fitted.size,
        fitted=crop.to_crop(fitted.fitted_landmarks) * fitted.size,
        heading=f"{title}: {fitted.model.name}, landmark error {fitted.landmark_error():.1%}",
    )
    with atomic_path(folder / "overlay.png") as path:
        write_png(path, sheet)


def histories(fitted: FittedFace) -> list[dict[str, Any]]:
    """Weighted energies before each step and after the last, one record a level."""
    records = []
    stats, levels = fitted.stats, len(fitted.models)
    coarser = reversed(range(len(stats.steps)))
    for history, used, halvings in zip(stats.energies, stats.steps, coarser, strict=True):
        records.append(
            {
                "name": "landmarks only" if halvings == levels else f"{fitted.size >> halvings} px",
                "steps": int(used),
                "terms": {
                    name: np.asarray(values)[: int(used) + 1].astype(float).tolist()
                    for name, values in history.items()
                },
            }
        )
    return records


def report(
    fitted: FittedFace, folder: Path, title: str, clock: Clock | None = None
) -> Mapping[str, Any]:
    """What ``report.json`` holds."""
    clock = clock or Clock()
    y, model = fitted.parameters, fitted.model
    yaw, pitch, roll = np.degrees(np.asarray(euler_yxz(rotation_matrix(y.rotation))))
    spread = np.asarray(fitted.posterior.vertex_deviation)
    face = np.asarray(fitted.models[-1].vertex_mask)
    focal = float(jnp.exp(y.log_focal))
    energies = histories(fitted)
    present = [
        {"file": name, "what": what} for name, what in _FILES.items() if (folder / name).is_file()
    ]
    return {
        "title": title,
        "subtitle": f"fitted with the model {model.name}, {model.vertex_count} vertices",
        "figures": [
            {
                "label": "landmark error (inner 51, of the eye distance)",
                "value": 100 * fitted.landmark_error(),
                "unit": "%",
            },
            {"label": "identity, root mean square", "value": _rms(y.identity), "unit": "sigma"},
            {"label": "expression, root mean square", "value": _rms(y.expression), "unit": "sigma"},
            {"label": "albedo, root mean square", "value": _rms(y.albedo), "unit": "sigma"},
            {
                "label": "median standard deviation of the face",
                "value": float(np.median(spread[face])),
                "unit": "mm",
            },
            {"label": "colour difference on the skin", "value": _misfit(fitted), "unit": ""},
        ],
        "images": [
            {"title": name, "file": name}
            for name in ("overlay.png", "texture.png", "albedo_partial.png", "visibility.png")
            if (folder / name).is_file()
        ],
        "energies": energies,
        "timings": [
            {
                "name": name,
                "seconds": seconds,
                "compile_seconds": clock.compiling.get(name, 0.0),
            }
            for name, seconds in clock.seconds.items()
        ],
        "tables": [
            {
                "title": "pose and camera",
                "header": ["quantity", "value"],
                "rows": [
                    ["yaw, pitch, roll (degrees)", [float(yaw), float(pitch), float(roll)]],
                    ["translation (mm)", np.asarray(y.translation).tolist()],
                    ["focal length (px of the photo)", focal * fitted.working.crop.side],
                    ["field of view of the crop (degrees)", _field_of_view(focal)],
                ],
            }
        ],
        "licences": _licences(model),
        "files": present,
        "environment": environment(),
    }


def _misfit(fitted: FittedFace) -> float:
    """``E_c`` on the pixels that show skin: mean distance in linear RGB, the face's median 0.5."""
    difference = np.asarray(fitted.render().color - fitted.working.data.image)
    weight = fitted.skin_map()
    total = np.sum(weight * np.linalg.norm(difference, axis=-1))
    return float(total / max(weight.sum(), 1.0))


def _licences(model: MorphableModel) -> list[dict[str, str]]:
    return [
        {"name": model.name, "what": "morphable model", "licence": model.licence},
        {
            "name": "BlazeFace and face mesh",
            "what": "face and landmark networks",
            "licence": "Apache-2.0, Google (MediaPipe)",
        },
    ]


def _rms(values: Any) -> float:
    flat = np.asarray(values)
    return float(np.sqrt(np.mean(flat**2))) if flat.size else 0.0


def _field_of_view(focal: float) -> float:
    return float(np.degrees(2 * np.arctan(0.5 / focal)))
