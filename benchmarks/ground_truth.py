"""Faces of known shape, albedo, pose and light, photographed by an independent renderer.

Draws coefficients from a morphable model, places the head before a perspective camera, renders it
with mitsuba under a distant light (shadows and bounces included) and writes for each face a photo
(8-bit sRGB PNG), the linear image (half EXR) and an ``.npz`` of everything known about it.

    python benchmarks/ground_truth.py --model makehuman --out /tmp/ground_truth
"""

import hashlib
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from environments import LIGHTS, draw_light, irradiance, map_directions, radiance_map
from head_props import fill_holes, painted_albedo
from mitsuba_scene import Surface, load_mitsuba, render, render_unshadowed
from PIL import Image

from jaxface.io.face_models import load_model
from jaxface.models.morphable import MorphableModel
from jaxface.models.subdivide import subdivide

IRISES = ((0.10, 0.05, 0.025), (0.10, 0.16, 0.22), (0.08, 0.11, 0.05))  # linear RGB
MESHES = ("vertices_camera", "albedo")
# Sliders that do not make a face by themselves, or move what the props stand for.
UNDRAWN = ("eyeLook", "mouthClose", "eyeBlink", "tongueOut")


def rotation_yxz(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """``Ry(yaw) Rx(pitch) Rz(roll)``, degrees."""
    (cy, cp, cr), (sy, sp, sr) = (f(np.deg2rad([yaw, pitch, roll])) for f in (np.cos, np.sin))
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_x = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    about_z = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    return about_y @ about_x @ about_z


def _twin(name: str) -> str | None:
    """The same slider on the other side of the face; None for one that moves both."""
    if name.startswith(("jaw", "mouthLeft", "mouthRight")):
        return None
    for side, other in (("_L", "_R"), ("_R", "_L"), ("Left", "Right"), ("Right", "Left")):
        if name.endswith(side):
            return name.removesuffix(side) + other
    return None


def draw_expression(model: MorphableModel, rng: np.random.Generator) -> np.ndarray:
    """Expression coefficients of a mild expression.

    Named sliders: up to six of them, positive, left and right nearly alike. Modes without sliders'
    names: all of them, N(0, 1). Scaled so that the head moves by 0.3 to 1.0 mm (root mean square
    over all vertices), which does not depend on how a model scales its modes.
    """
    names = model.expression_names
    z = np.zeros(model.expression.count)
    if len(z) == 0:
        return z
    sliders = [i for i, name in enumerate(names) if not name.startswith(UNDRAWN)]
    if "jawOpen" in names:
        for index in rng.choice(sliders, min(6, len(sliders)), replace=False):
            z[index] = abs(rng.normal())
            twin = _twin(names[index])
            if twin in names:
                z[names.index(twin)] = z[index] * rng.uniform(0.8, 1.2)
    else:
        z = rng.normal(size=len(z))
    moved = np.asarray(model.expression(z.astype(np.float32)))
    rms = np.sqrt(np.mean(np.sum(moved**2, axis=1)))
    return z * rng.uniform(0.3, 1.0) / rms


def place(
    vertices: np.ndarray, focus: np.ndarray, yaw: float, size: int, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """A camera of random field of view (15 to 40 degrees) and a pose that fills its frame."""
    fov = rng.uniform(15.0, 40.0)
    rotation = rotation_yxz(yaw + rng.uniform(-2, 2), rng.uniform(-8, 8), rng.uniform(-6, 6))
    reach = rng.uniform(270.0, 340.0)  # mm that the frame covers at the face
    distance = 0.5 * reach / np.tan(np.deg2rad(fov) / 2)
    target = np.array([rng.uniform(-12, 12), rng.uniform(-12, 12), -distance])
    translation = target - rotation @ focus
    focal = 0.5 * size / np.tan(np.deg2rad(fov) / 2)
    return {
        "rotation": rotation,
        "translation": translation,
        "focal": np.array(focal),
        "principal": np.array([size / 2.0, size / 2.0]),
        "fov": np.array(fov),
    }


def backdrop(kind: str, size: int, rng: np.random.Generator) -> np.ndarray:
    """A background (size, size, 3), linear RGB: ``plain``, ``gradient`` or ``noise``."""
    first, second = rng.uniform(0.03, 0.6, (2, 3))
    if kind == "plain":
        return np.broadcast_to(first, (size, size, 3))
    if kind == "gradient":
        ramp = np.linspace(0.0, 1.0, size)[:, None, None]
        return np.broadcast_to(first * (1 - ramp) + second * ramp, (size, size, 3))
    coarse = Image.fromarray(rng.integers(0, 255, (9, 9, 3), dtype=np.uint8))
    blurred = np.asarray(coarse.resize((size, size), Image.Resampling.BICUBIC)) / 255.0
    return first * (1 - blurred) + second * blurred


def to_srgb(linear: np.ndarray) -> np.ndarray:
    """8-bit sRGB of linear RGB, clipped."""
    clipped = np.clip(linear, 0.0, 1.0)
    encoded = np.where(
        clipped <= 0.0031308,
        12.92 * clipped,
        1.055 * np.maximum(clipped, 1e-9) ** (1 / 2.4) - 0.055,
    )
    return np.round(255 * encoded).astype(np.uint8)


def model_digest(model: MorphableModel) -> str:
    """Fingerprint of a model: coefficients mean the same face only where it agrees."""
    bases = (model.identity.basis, model.expression.basis, model.albedo.basis)
    arrays = (model.mean, model.albedo_mean, model.faces, *bases)
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted unit vertex normals (n, 3)."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    face = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], face)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


class Subject:
    """One drawn face in the model's frame (mm) with its albedo (linear RGB)."""

    def __init__(self, model: MorphableModel, rng: np.random.Generator, paint: bool):
        if model.landmarks68 is None:
            raise ValueError(f"model {model.name!r} has no 68 landmarks; the generator needs them")
        self.model = model
        self.mean, self.faces = np.asarray(model.mean, float), np.asarray(model.faces)
        self.landmarks = np.asarray(model.landmarks68(model.mean), float)
        self.identity = rng.normal(size=model.identity.count)
        self.expression = draw_expression(model, rng)
        self.albedo_coefficients = rng.normal(size=model.albedo.count)
        if paint:
            self.albedo_coefficients = np.zeros(0)
            self.albedo = painted_albedo(self.mean, self.landmarks, rng)
        else:
            albedo = model.reflectance(self.albedo_coefficients.astype(np.float32))
            self.albedo = np.clip(np.asarray(albedo), 0.005, 0.95)
        self.iris = np.array(IRISES[rng.integers(len(IRISES))])
        self.shape = np.asarray(
            model.shape(self.identity.astype(np.float32), self.expression.astype(np.float32)), float
        )


def photograph(
    mi,
    subject: Subject,
    yaw: float,
    light_name: str,
    rng: np.random.Generator,
    size: int,
    samples: int,
    shadows: bool,
    roughness: float | None,
    seed: int,
) -> tuple[np.ndarray, np.ndarray, dict]:
    """Photo (uint8 sRGB), linear RGBA, and the truth of one face in one pose and light."""
    focus = subject.landmarks[27:48].mean(axis=0) - np.array([0.0, 0.0, 40.0])
    view = place(subject.shape, focus, yaw, size, rng)
    rotation, translation = view["rotation"], view["translation"]
    vertices = subject.shape @ rotation.T + translation
    light = draw_light(light_name, rng)
    radiance = radiance_map(light)
    surfaces = [Surface(vertices, subject.faces, subject.albedo, roughness)]
    surfaces += fill_holes(
        subject.mean, vertices, subject.faces, subject.landmarks, rotation[:, 2], subject.iris
    )
    fov = float(view["fov"])
    if shadows:
        image = render(mi, surfaces, radiance, fov, size, samples, 4, seed)
    else:
        shading = [
            irradiance(radiance, vertex_normals(s.vertices, s.faces)) / np.pi for s in surfaces
        ]
        image = render_unshadowed(mi, surfaces, shading, fov, size, samples, seed)
    covered = image[..., 3] > 0.99
    luminance = image[covered][:, :3] @ np.array([0.2126, 0.7152, 0.0722])
    exposure = 0.6 / np.percentile(luminance, 97)
    image[..., :3] *= exposure
    kind = ("plain", "gradient", "noise")[rng.integers(3)]
    alpha = np.clip(image[..., 3:], 0.0, 1.0)
    photo = to_srgb(image[..., :3] + (1 - alpha) * backdrop(kind, size, rng))
    ball = map_directions(24).reshape(-1, 3)
    truth = {
        **view,
        "identity": subject.identity,
        "expression": subject.expression,
        "albedo_coefficients": subject.albedo_coefficients,
        "albedo": subject.albedo,
        "vertices_camera": vertices,
        "light": light.table(),
        "exposure": np.array(exposure),
        "sphere_normals": ball,
        "sphere_irradiance": exposure * irradiance(radiance, ball),
    }
    single = {k: np.asarray(v, np.float32) for k, v in truth.items()}
    names = {
        "model": subject.model.name,
        "digest": model_digest(subject.model),
        "light_name": light_name,
        "backdrop": kind,
        "yaw": yaw,
        "shadows": shadows,
        "roughness": roughness if roughness is not None else -1.0,
        "seed": seed,
        "size": size,
    }
    return photo, image, {**single, **{k: np.array(v) for k, v in names.items()}}


def main(
    out: Annotated[Path, typer.Option(help="folder to write to")],
    model: Annotated[str, typer.Option(help="name or file of a morphable model")] = "makehuman",
    subjects: Annotated[int, typer.Option(help="number of faces drawn")] = 2,
    yaw: Annotated[list[float], typer.Option(help="degrees")] = [0, 10, 20, 30, 40],  # noqa: B006
    light: Annotated[list[str], typer.Option(help=f"of {LIGHTS}")] = list(LIGHTS),  # noqa: B006
    size: Annotated[int, typer.Option(help="pixels along a side")] = 512,
    samples: Annotated[int, typer.Option(help="paths per pixel")] = 100,
    shadows: Annotated[bool, typer.Option(help="cast shadows and bounces, as in a photo")] = True,
    roughness: Annotated[float | None, typer.Option(help="add a glossy coat (0.3: skin)")] = None,
    paint: Annotated[bool, typer.Option(help="paint the albedo instead of drawing it")] = False,
    refine: Annotated[int, typer.Option(help="subdivide the model so many times")] = 0,
    lean: Annotated[bool, typer.Option(help="JPEG and coefficients only, for tests")] = False,
    seed: Annotated[int, typer.Option()] = 0,
    variant: Annotated[str, typer.Option(help="mitsuba variant")] = "scalar_rgb",
) -> None:
    """Draw faces from a model and photograph each in every yaw and light."""
    mi = load_mitsuba(variant)
    source = subdivide(load_model(model), refine)
    paint = paint or source.albedo.count == 0
    out.mkdir(parents=True, exist_ok=True)
    for number in range(subjects):
        subject = Subject(source, np.random.default_rng([seed, number]), paint)
        for angle in yaw:
            for index, name in enumerate(light):
                stem = f"{source.name}_s{number}_y{angle:02.0f}_{name}"
                own = 1000 * number + 10 * int(angle) + index
                rng = np.random.default_rng([seed, number, int(angle), index])
                photo, image, truth = photograph(
                    mi, subject, angle, name, rng, size, samples, shadows, roughness, own
                )
                if lean:
                    Image.fromarray(photo).save(out / f"{stem}.jpg", quality=92)
                    kept = {k: v for k, v in truth.items() if k not in MESHES}
                    np.savez_compressed(out / f"{stem}.npz", **kept)
                    continue
                Image.fromarray(photo).save(out / f"{stem}.png")
                mi.Bitmap(image.astype(np.float16)).write(str(out / f"{stem}.exr"))
                np.savez_compressed(out / f"{stem}.npz", **truth)
                typer.echo(stem)


if __name__ == "__main__":
    typer.run(main)
