"""Albedo textures from rendered photos, against the albedo that was rendered.

Faces of known albedo (half of them painted, outside the model's albedo basis) with a gloss, all
under one light and each in its own exposure, are photographed from the front by mitsuba and
go through ``database build``. Compared are the texels that a photo shows.

    python benchmarks/photo_database.py --photos /tmp/photos
"""

import tempfile
from pathlib import Path
from typing import Annotated

import jax.numpy as jnp
import numpy as np
import typer
from environments import draw_light, radiance_map
from ground_truth import Subject, place, to_srgb
from head_props import fill_holes
from mitsuba_scene import Surface, load_mitsuba, render
from PIL import Image

from jaxface.geometry.uv import uv_layout
from jaxface.io.face_models import load_model
from jaxface.models.skin.regions import skin_fields
from jaxface.pipeline.databases.from_photos import build_database

GLOSS = 0.35
"""roughness of the coat"""


def photograph(model, number: int, light, size: int, samples: int, seed: int):
    """8-bit photo, and albedo at the vertices, of one face; odd ones are painted."""
    rng = np.random.default_rng([seed, number])
    subject = Subject(model, rng, paint=number % 2 == 1)
    focus = subject.landmarks[27:48].mean(axis=0) - np.array([0.0, 0.0, 40.0])
    view = place(subject.shape, focus, 0.0, size, rng)
    vertices = subject.shape @ view["rotation"].T + view["translation"]
    surfaces = [Surface(vertices, subject.faces, subject.albedo, GLOSS)]
    surfaces += fill_holes(
        subject.mean, vertices, subject.faces, subject.landmarks, view["rotation"][:, 2],
        subject.iris,
    )  # fmt: skip
    mi = load_mitsuba("scalar_rgb")
    image = render(mi, surfaces, radiance_map(light), float(view["fov"]), size, samples, 4, number)
    covered = image[..., 3] > 0.99
    luminance = image[covered][:, :3] @ np.array([0.2126, 0.7152, 0.0722])
    exposure = rng.uniform(0.45, 0.7) / np.percentile(luminance, 97)
    alpha = np.clip(image[..., 3:], 0.0, 1.0)
    return to_srgb(exposure * image[..., :3] + (1 - alpha) * 0.4), subject.albedo


def take_photos(folder: Path, subjects: int, size: int, samples: int, seed: int) -> None:
    """Write ``sN.png`` and ``sN.npz`` of every subject; those that are there are kept."""
    folder.mkdir(parents=True, exist_ok=True)
    model = load_model("makehuman")
    light = draw_light("soft", np.random.default_rng(seed))
    for number in range(subjects):
        if (folder / f"s{number}.npz").is_file():
            continue
        photo, albedo = photograph(model, number, light, size, samples, seed)
        Image.fromarray(photo).save(folder / f"s{number}.png")
        np.savez(folder / f"s{number}.npz", albedo=albedo)
        print(f"s{number}", flush=True)


def frontal(model, layout) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Texels of skin that face forward on the mean face, and the parts among them."""
    fields = skin_fields(model)
    front = (np.asarray(fields.normal)[:, 2] > 0.5).astype(np.float32)
    regions = fields.regions
    names = ("skin", "lips", "cheek", "forehead", "nose", "brow", "scalp", "neck", "ear")
    stack = np.stack([front, *(np.asarray(getattr(regions, n)) for n in names)], axis=-1)
    maps = np.asarray(layout(jnp.asarray(stack, jnp.float32), model.faces))
    parts = {name: maps[..., 1 + i] > 0.5 for i, name in enumerate(names)}
    inside = (np.asarray(layout.triangle) >= 0) & (maps[..., 0] > 0.5)
    face = inside & (parts["skin"] | parts["lips"]) & ~parts["scalp"] & ~parts["neck"]
    face &= ~parts["ear"] & ~parts["brow"]
    return face, {n: face & parts[n] for n in ("lips", "cheek", "forehead", "nose")}


def measure(database, photos: Path, model) -> list[dict]:
    """Relative errors of every subject's albedo, and of the model's mean albedo for comparison.

    ``error``: mean over texels of ``|a - t| / |t|``; ``matched``: after one factor for all
    channels; ``tone``: of the mean colours after that factor; then the signed error of the parts'
    mean luminance, after that factor.
    """
    layout = uv_layout(model.uv, model.uv_faces, database.resolution)
    face, parts = frontal(model, layout)
    mean = np.asarray(layout(jnp.clip(model.albedo_mean, 0, 1), model.faces))
    weights = np.array([0.2126, 0.7152, 0.0722])
    rows = []
    for subject in database.names:
        truth = np.load(photos / f"{subject}.npz")["albedo"]
        true = np.asarray(layout(jnp.asarray(truth, jnp.float32), model.faces))
        row = {"subject": subject}
        for label, found in (("", database.albedo(subject)), ("mean face ", mean)):
            norm = np.linalg.norm(true[face], axis=-1)

            def error(a, norm=norm, true=true):
                return float(np.mean(np.linalg.norm(a[face] - true[face], axis=-1) / norm))

            gain = np.median((true[face] @ weights) / np.maximum(found[face] @ weights, 1e-4))
            row[label + "error"] = error(found)
            row[label + "matched"] = error(found * gain)
            tone, aim = gain * found[face].mean(0), true[face].mean(0)
            row[label + "tone"] = float(np.linalg.norm(tone - aim) / np.linalg.norm(aim))
            if label:
                continue
            row["gain"] = float(gain)
            for name, part in parts.items():
                ratio = gain * (found[part] @ weights).mean() / (true[part] @ weights).mean()
                row[name] = float(ratio - 1)
        rows.append(row)
    return rows


def main(
    photos: Annotated[Path, typer.Option(help="folder of the renders, made if absent")],
    subjects: Annotated[int, typer.Option()] = 4,
    size: Annotated[int, typer.Option(help="of the photos, px")] = 384,
    samples: Annotated[int, typer.Option(help="paths per pixel")] = 48,
    fit_size: Annotated[int, typer.Option(help="of the fits' working image, px")] = 256,
    resolution: Annotated[int, typer.Option(help="of the textures")] = 512,
    specularity: Annotated[bool, typer.Option(help="remove it")] = True,
    common_light: Annotated[bool, typer.Option(help="one light for all")] = True,
    out: Annotated[Path | None, typer.Option(help="of the database, temporary if absent")] = None,
    seed: Annotated[int, typer.Option()] = 0,
    write: Annotated[bool, typer.Option(help="results/photo_database.md")] = False,
) -> None:
    take_photos(photos, subjects, size, samples, seed)
    model = load_model("makehuman")
    with tempfile.TemporaryDirectory() as temporary:
        database = build_database(
            photos, out or temporary, resolution, licence="rendered", model=model, size=fit_size,
            common_light=common_light, remove_specularity=specularity,
            on_progress=lambda s: print(s.stage, s.done, s.total, s.problem or "", flush=True),
        )  # fmt: skip
        rows = measure(database, photos, model)
    keys = list(rows[0])
    lines = ["# photo_database", "", "| " + " | ".join(keys) + " |", "|" + " --- |" * len(keys)]
    rows.append({k: np.mean([r[k] for r in rows]) if k != "subject" else "mean" for k in keys})
    for row in rows:
        cells = [row[k] if k == "subject" else f"{row[k]:.3f}" for k in keys]
        lines.append("| " + " | ".join(cells) + " |")
    facts = f"{subjects} photos of {size} px, {samples} paths a pixel, gloss {GLOSS}, fits at "
    facts += f"{fit_size} px, textures of {resolution}, common light {common_light}, "
    lines += ["", facts + f"specularity removed {specularity}", ""]
    print("\n".join(lines))
    if write:
        (Path(__file__).parent / "results" / "photo_database.md").write_text("\n".join(lines))


if __name__ == "__main__":
    typer.run(main)
