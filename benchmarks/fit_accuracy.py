"""How accurate the fit is on faces whose shape, albedo and light are known.

Fits every photo that ``ground_truth.py`` wrote, starting from detected landmarks, with the model
that the face was drawn from, and reports for each yaw and light: the distance of corresponding
vertices over the face region (``fit_metrics.py`` says which) after a similarity transform, that of
the mean face, albedo and light up to their common scale, and landmark distances in percent of the
distance between the outer eye corners (inner 51 points).

    python benchmarks/ground_truth.py --model makehuman --refine 2 --out /tmp/faces
    python benchmarks/fit_accuracy.py /tmp/faces
"""

import dataclasses
import json
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from fit_metrics import Estimate, compare, face_region, load_truth, sphere
from ground_truth import model_digest
from harness import RESULTS, provenance
from photo_fit import fit_photo
from PIL import Image

from jaxface.io.face_models import load_model
from jaxface.io.pictures.drawing import draw_landmarks
from jaxface.io.pictures.overlay import contact_sheet
from jaxface.models.morphable import MorphableModel
from jaxface.models.subdivide import subdivide
from jaxface.pipeline.databases.embedding import embed_landmarks
from jaxface.render.shading import irradiance
from jaxface.run.compile_cache import enable_compilation_cache

COLUMNS = (
    ("median", "median mm"),
    ("mean", "mean mm"),
    ("p95", "95% mm"),
    ("mean_face_median", "mean face, median mm"),
    ("ratio", "ratio"),
    ("albedo", "albedo"),
    ("mean_albedo", "mean albedo"),
    ("light", "light"),
    ("ambient_light", "ambient light"),
    ("landmarks_fit_to_detected", "fit to detected %"),
    ("landmarks_detected_to_true", "detected to true %"),
    ("rotation", "rotation deg"),
)


def matching_level(model: MorphableModel, vertices: int) -> int:
    """How often the model was subdivided for renders of this many vertices.

    Raises:
        ValueError: no level up to 3 has that many.
    """
    for level in range(4):
        if subdivide(model, level).vertex_count == vertices:
            return level
    raise ValueError(f"model {model.name!r} has no level of {vertices} vertices; another model?")


def averages(rows: list[dict]) -> dict[tuple[str, str], dict[str, float]]:
    """Means over the subjects for each yaw and light, each yaw, and all."""
    groups: dict[tuple[str, str], list[dict]] = {}
    for row in rows:
        for key in ((row["yaw"], row["light_name"]), (row["yaw"], "all"), ("all", "all")):
            groups.setdefault((str(key[0]), key[1]), []).append(row)
    order = sorted(groups, key=lambda k: (k[0] == "all", float(k[0]) if k[0] != "all" else 0, k[1]))
    return {
        key: {name: float(np.mean([row[name] for row in groups[key]])) for name, _ in COLUMNS}
        for key in order
    }


def table(rows: list[dict]) -> str:
    """A Markdown table, one line for each yaw and light."""
    header = ["yaw", "light", *(title for _, title in COLUMNS)]
    lines = [header, ["---:", "---", *["---:"] * len(COLUMNS)]]
    for (yaw, light), values in averages(rows).items():
        lines.append([yaw, light, *(f"{values[name]:.3g}" for name, _ in COLUMNS)])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _balls(estimate: Estimate, truth: dict[str, np.ndarray], size: int) -> np.ndarray:
    """Grey balls in the true light (left) and the estimated one (right), equally bright."""
    normals, inside = sphere(size)
    found = np.asarray(irradiance(normals, estimate.light))
    samples = truth["sphere_normals"]
    nearest = np.argmax(normals.reshape(-1, 3) @ samples.T, axis=1).reshape(size, size)
    known = truth["sphere_irradiance"][nearest] / np.pi
    balls = [np.clip(0.7 * b / np.percentile(b[inside], 99), 0, 1) for b in (known, found)]
    return np.concatenate([np.where(inside[..., None], b, 0.02) for b in balls], axis=1)


def picture(photo: np.ndarray, estimate: Estimate, truth: dict[str, np.ndarray]) -> np.ndarray:
    """The photo with detected and fitted landmarks, and the lights as two balls."""
    marked = draw_landmarks(photo, estimate.detected)
    marked = np.array(draw_landmarks(marked, estimate.landmarks))
    balls = np.round(255 * _balls(estimate, truth, 72) ** (1 / 2.2)).astype(np.uint8)
    marked[-balls.shape[0] :, : balls.shape[1]] = balls
    return marked


def main(
    folder: Annotated[Path, typer.Argument(help="written by ground_truth.py, of one model")],
    model: Annotated[str, typer.Option(help="the model that the faces were drawn from")] = (
        "makehuman"
    ),
    details: Annotated[str, typer.Option(help="subdivision on each level, e.g. 0,1,2")] = "",
    embed: Annotated[bool, typer.Option(help="find 468 points on a model without them")] = True,
    only: Annotated[str, typer.Option(help="of the photos, those whose name has this")] = "",
    output: Annotated[Path, typer.Option(help="folder of the results")] = RESULTS,
    sheet: Annotated[Path | None, typer.Option(help="contact sheet (PNG) to write")] = None,
) -> None:
    """Fit every photo of a folder and compare with the truth."""
    enable_compilation_cache()
    stems = sorted(p for p in folder.glob("*.npz") if only in p.stem)
    if not stems:
        raise typer.BadParameter(f"{folder} has no renders; make some with ground_truth.py")
    source = load_model(model)
    finest = tuple(int(level) for level in details.split(",")) if details else None
    truth_model = subdivide(source, matching_level(source, len(load_truth(stems[0])["albedo"])))
    digest = model_digest(truth_model)
    embedded = embed and source.landmarks468 is None
    if embedded:
        source = dataclasses.replace(source, landmarks468=embed_landmarks(source).points)
    region = face_region(truth_model)
    rows, panels = [], []
    for stem in stems:
        truth = load_truth(stem)
        if str(truth["digest"]) != digest:
            raise typer.BadParameter(f"{stem} is a face of another {truth['model']}; render anew")
        photo = np.asarray(Image.open(stem.with_suffix(".png")).convert("RGB"))
        estimate = fit_photo(photo, source, finest)
        figures = compare(estimate, truth, truth_model, region)
        facts = {
            "name": stem.stem,
            "yaw": float(truth["yaw"]),
            "light_name": str(truth["light_name"]),
        }
        rows.append({**facts, **figures})
        typer.echo(f"{stem.stem}: median {figures['median']:.2f} mm, ratio {figures['ratio']:.2f}")
        title = f"{stem.stem}  {figures['median']:.2f} mm"
        panels.append((title, picture(photo, estimate, truth)))
    text = table(rows)
    typer.echo("\n" + text)
    output.mkdir(parents=True, exist_ok=True)
    origin = provenance(["jax", "jaxlib", "numpy", "optimistix", "equinox"])
    report = {
        "model": source.name,
        "details": details or "default",
        "landmarks": "468, embedded" if embedded else "as the model has them",
        "region_vertices": len(region),
        "provenance": origin,
        "photos": rows,
    }
    target = output / f"fit_accuracy_{source.name}"
    target.with_suffix(".json").write_text(json.dumps(report, indent=1) + "\n")
    target.with_suffix(".md").write_text(f"# fit_accuracy, {source.name}\n\n{text}\n")
    if sheet:
        Image.fromarray(contact_sheet(panels, columns=6, cell=320)).save(sheet)


if __name__ == "__main__":
    typer.run(main)
