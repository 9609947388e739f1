"""Completed albedo -> files: maps, blend, pictures, meshes, report."""

import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxface.imaging.colour import srgb_to_linear
from jaxface.imaging.resample import block_means
from jaxface.io.atomic import atomic_path
from jaxface.io.formats.exr import write_exr
from jaxface.io.formats.image import write_png
from jaxface.io.formats.retexture import retexture_glb, retexture_obj
from jaxface.io.pictures.overlay import contact_sheet
from jaxface.io.pictures.report import write_report
from jaxface.io.texture_database import TextureDatabase
from jaxface.models.parameters import FaceParameters
from jaxface.pipeline.texture.records import Completed
from jaxface.pipeline.texture.seen import SeenTexture
from jaxface.pipeline.texture.views import face_views
from jaxface.run.environment import environment

_FILES = {
    "albedo.exr": "complete albedo, UV, linear half float RGB",
    "albedo.png": "the same, sRGB; the meshes' texture",
    "blend.json": "weights of the database's subjects, objective, certified gap",
    "grams.npz": "the Gram matrices that the synthesis was to match",
    "completion.png": "partial, low frequencies, neighbours, result, close-ups",
    "face.png": "the face with its complete albedo from three sides, and close with no expression",
}


def save_completed(
    place: Path,
    done: Completed,
    seen: SeenTexture,
    parameters: FaceParameters,
    textures: TextureDatabase,
    network_licence: str,
    seconds: float,
) -> None:
    """Write a completed albedo beside the fit that it belongs to; the report last.

    Args:
        place: folder of the fit; its meshes get the new texture.
        done: the completion.
        seen: what it started from.
        parameters: of the fit.
        textures: the database.
        network_licence: of the feature network.
        seconds: how long it took.
    """
    linear = np.asarray(srgb_to_linear(jnp.asarray(done.albedo)))
    write_exr(place / "albedo.exr", linear, half=True)
    write_png(place / "albedo.png", done.albedo)
    with atomic_path(place / "grams.npz") as temporary, open(temporary, "wb") as file:
        entries: dict[str, Any] = done.targets
        np.savez_compressed(file, **entries)
    blended = done.blended
    order = [int(i) for i in np.argsort(-blended.weights)]
    weights = [
        {"subject": done.names[i], "weight": float(blended.weights[i])}
        for i in order
        if blended.weights[i] > 0
    ]
    facts = {
        "schema": 1,
        "database": textures.name,
        "compared_at": done.analysed_at,
        "compared_by": done.compared_by,
        "weights": weights,
        "objective": float(blended.objective),
        "lower_bound": float(blended.lower_bound),
        "gap": float(blended.gap),
        "relative_gap": float(blended.relative_gap),
        "residuals": {name: float(value) for name, value in blended.residuals.items()},
    }
    with atomic_path(place / "blend.json") as temporary:
        temporary.write_text(json.dumps(facts, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    write_png(place / "completion.png", _sheet(done, seen, textures, order))
    views = face_views(seen.model, parameters, linear)
    write_png(place / "face.png", contact_sheet(views, columns=2, heading="complete face"))
    if (place / "mesh.glb").is_file():
        retexture_glb(place / "mesh.glb", (place / "albedo.png").read_bytes())
    if (place / "mesh.mtl").is_file():
        retexture_obj(place / "mesh.obj", "albedo.png")
    _extend_report(place, done, textures, network_licence, seconds, weights)


def _sheet(
    done: Completed, seen: SeenTexture, textures: TextureDatabase, order: list[int]
) -> np.ndarray:
    box = done.box
    partial = np.where(seen.weight[..., None] > 0, seen["photo"], 0.5)
    panels = [
        ("partial albedo", partial[box]),
        ("low frequencies", seen["low_frequency"][box]),
        ("before synthesis", done.start[box]),
        ("complete albedo", done.albedo[box]),
    ]
    shown = [i for i in order if done.blended.weights[i] > 0.01][:4]
    for index in shown:
        texture = textures.encoded(done.names[index])
        side = min(len(texture), seen.resolution)
        factor = seen.resolution // side
        rows, columns = (slice(s.start // factor, s.stop // factor) for s in box)
        name = f"{done.names[index]}: {done.blended.weights[index]:.0%}"
        panels.append((name, block_means(texture, side)[rows, columns]))
    size = 320
    for name, (v, u) in _close_ups(seen).items():
        rows = slice(max(v - size // 2, 0), v + size // 2)
        columns = slice(max(u - size // 2, 0), u + size // 2)
        panels.append((f"{name}, one to one", done.albedo[rows, columns]))
    return contact_sheet(panels, columns=4, heading="complete albedo")


def _close_ups(seen: SeenTexture) -> dict[str, tuple[int, int]]:
    """Row and column in the middle of some regions of the synthesised part."""
    names = seen.model.region_names
    region = np.asarray(seen.model.region)[seen["vertex"]]
    found = {}
    for name in ("forehead", "nose", "cheeks", "lips"):
        if name in names:
            rows, columns = np.nonzero(seen["free"] & (region == names.index(name)))
            if len(rows):
                # Of two cheeks the one on the left of the map.
                left = columns <= np.median(columns) if name == "cheeks" else columns >= 0
                found[name] = int(np.median(rows[left])), int(np.median(columns[left]))
    return found


def _extend_report(
    place: Path,
    done: Completed,
    textures: TextureDatabase,
    network_licence: str,
    seconds: float,
    weights: list[dict[str, Any]],
) -> None:
    report: dict[str, Any]
    try:
        report = json.loads((place / "report.json").read_text(encoding="utf-8"))
    except (OSError, json.JSONDecodeError):
        report = {"title": place.name}

    def joined(key: str, column: str, new: list[dict[str, Any]]) -> list[dict[str, Any]]:
        """Entries of before, less those that the new ones replace, and the new ones."""
        fresh = {entry[column] for entry in new}
        return [e for e in report.get(key, []) if e.get(column) not in fresh] + new

    pictures = ("face.png", "completion.png", "albedo.png")
    images = [{"title": name, "file": name} for name in pictures]
    report["images"] = joined("images", "file", images)
    report["files"] = joined(
        "files", "file", [{"file": name, "what": what} for name, what in _FILES.items()]
    )
    report["figures"] = joined(
        "figures", "label",
        [
            {
                "label": "relative duality gap of the blend",
                "value": float(done.blended.relative_gap),
                "unit": "",
            },
            {"label": "subjects blended", "value": len(weights), "unit": ""},
        ],
    )  # fmt: skip
    report["energies"] = joined(
        "energies", "name",
        [
            {
                "name": f"synthesis {record['name']}",
                "steps": len(record["values"]) - 1,
                "terms": {"synthesis": record["values"]},
            }
            for record in done.levels
        ],
    )  # fmt: skip
    report["timings"] = joined(
        "timings", "name", [{"name": "complete albedo", "seconds": seconds, "compile_seconds": 0.0}]
    )
    table = {
        "title": "blended subjects",
        "header": ["subject", "weight"],
        "rows": [[entry["subject"], entry["weight"]] for entry in weights],
    }
    report["tables"] = joined("tables", "title", [table])
    report["licences"] = joined(
        "licences", "name",
        [
            {"name": textures.name, "what": "texture database", "licence": textures.licence},
            {"name": "feature network", "what": "texture statistics", "licence": network_licence},
        ],
    )  # fmt: skip
    write_report(place, {**report, "environment": environment()})
