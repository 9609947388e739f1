"""Real skin of which a part is hidden, to be completed from the rest and a database."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from scipy.ndimage import binary_erosion, distance_transform_edt, gaussian_filter

from jaxface._types import Array, Bool, Float
from jaxface.geometry.uv import uv_layout
from jaxface.imaging.colour import srgb_to_linear
from jaxface.imaging.masks import smoothstep
from jaxface.imaging.resample import block_means
from jaxface.io.face_models import load_model
from jaxface.io.texture_database import TextureDatabase
from jaxface.models.morphable import MorphableModel
from jaxface.models.subdivide import subdivide
from jaxface.pipeline.databases.scan import import_scan
from jaxface.pipeline.texture.seen import SeenTexture, seen_texture

SCAN = "lee-perry-smith"
SCAN_LICENCE = 'CC-BY 3.0, "Infinite, 3D Head Scan by Lee Perry-Smith" (ir-ltd.net)'

EDGE = 1 / 64
"""of the texture's side: width of the smooth edge of what is seen"""

NOT_MEASURED = ("lips", "eyelids")
"""where a transferred scan has holes that were filled"""


class Skins(TextureDatabase):
    """Textures in memory behind the interface of a database."""

    def __init__(self, name: str, textures: Mapping[str, Float[np.ndarray, "r r 3"]]) -> None:
        self.name, self.licence = name, "see the databases"
        self.textures = dict(textures)
        self.resolution = len(next(iter(self.textures.values())))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the subjects."""
        return tuple(self.textures)

    def __len__(self) -> int:
        return len(self.textures)

    def encoded(self, name: str) -> Float[np.ndarray, "r r 3"]:
        """A subject's albedo, sRGB-encoded."""
        return self.textures[name]

    def first(self, count: int) -> "Skins":
        """A database of the first subjects alone."""
        return Skins(self.name, dict(list(self.textures.items())[:count]))

    def joined(self, other: "Skins") -> "Skins":
        """A database of both."""
        return Skins(f"{self.name}, {other.name}", {**self.textures, **other.textures})


def read_skins(folder: str | os.PathLike[str], side: int, without: Sequence[str] = ()) -> Skins:
    """A database's textures at a lower resolution."""
    stored = TextureDatabase(folder)
    return Skins(stored.name, {
        name: block_means(stored.encoded(name), side)
        for name in stored.names if name not in without
    })  # fmt: skip


@dataclass(frozen=True)
class Case:
    """Skin of which a part is seen."""

    name: str
    truth: Float[np.ndarray, "r r 3"]
    """sRGB-encoded"""
    seen: SeenTexture
    hidden: Bool[np.ndarray, "r r"]
    """skin of the face of which nothing is seen"""
    shown: Bool[np.ndarray, "r r"]
    """skin of the face that is wholly seen"""

    def pasted(self, texture: Float[np.ndarray, "r r 3"]) -> Float[np.ndarray, "r r 3"]:
        """A texture with what is seen over it."""
        weight = self.seen.weight[..., None]
        return weight * self.seen["photo"] + (1 - weight) * texture


def read_truth(folder: str | os.PathLike[str] | None, side: int) -> np.ndarray:
    """The scan's albedo in the bundled model's UVs, sRGB-encoded.

    Args:
        folder: database that holds it; without one the scan of the data folder is registered
            (a minute).
        side: texels along a side.
    """
    if folder is not None:
        return block_means(TextureDatabase(folder).encoded(SCAN), side)
    data = Path(os.environ.get("JAXFACE_DATA", Path(__file__).parents[2] / "shared" / "data"))
    scan = data / "lps_head"
    out = Path(os.environ.get("TMPDIR", "/tmp")) / "jaxface-held-out-skin"
    database, _ = import_scan(
        scan / "head.obj", scan / "head_diffuse.jpg", out, 1024, subject=SCAN, licence=SCAN_LICENCE
    )
    return block_means(database.encoded(SCAN), side)


def coefficients(
    model: MorphableModel, truth: Float[np.ndarray, "r r 3"], weight: Float[np.ndarray, "r r"]
) -> np.ndarray:
    """Albedo coefficients of the model, least squares on what is seen (with the unit prior)."""
    linear = np.asarray(srgb_to_linear(jnp.asarray(truth)))
    layout = uv_layout(model.uv, model.uv_faces, len(truth))
    used = (weight > 0.99) & np.asarray(layout.inside)

    def texels(albedo: Array) -> np.ndarray:
        return np.asarray(layout(albedo, model.faces))[used].ravel()

    modes = [texels(model.albedo.basis[..., k]) for k in range(model.albedo.count)]
    columns = np.stack(modes, axis=1).astype(float)
    rest = linear[used].ravel() - texels(model.albedo_mean)
    # Neighbouring texels repeat each other: a thousand count as one, good to 0.05.
    precision = 1 / (1000 * 0.05**2)
    normal = precision * columns.T @ columns + np.eye(columns.shape[1])
    return np.linalg.solve(normal, precision * columns.T @ rest).astype(np.float32)


def make_case(truth: Float[np.ndarray, "r r 3"], name: str) -> Case:
    """Show the ``left`` or ``right`` half of the map, or the ``oval`` of a frontal view alone."""
    base = load_model("makehuman")
    model = subdivide(base)
    side = len(truth)
    plain = np.zeros(model.albedo.count, np.float32)
    linear = np.asarray(srgb_to_linear(jnp.asarray(truth)))
    everything = seen_texture(model, linear, np.ones((side, side)), plain, 1.0)
    free = everything["free"]
    rows, columns = np.nonzero(free)
    v, u = np.mgrid[:side, :side] + 0.5
    if name == "left":
        inside = u < side / 2
    elif name == "right":
        inside = u > side / 2
    elif name == "oval":
        height, width = np.ptp(rows) / 2, np.ptp(columns) / 2
        middle = rows.min() + height
        inside = ((v - middle) / (0.85 * height)) ** 2 + ((u - side / 2) / (0.5 * width)) ** 2 < 1
    else:
        raise ValueError(f"case is {name!r}; needed is 'left', 'right' or 'oval'")
    depth = distance_transform_edt(inside & everything["skin"]) / (EDGE * side)
    weight = smoothstep(depth, 0.0, 1.0).astype(np.float32) * free
    seen = seen_texture(model, linear, weight, coefficients(model, truth, weight), 1.0)
    region = np.asarray(model.region)[seen["vertex"]]
    skipped = [model.region_names.index(n) for n in NOT_MEASURED]
    measured = free & ~np.isin(region, skipped)
    measured = binary_erosion(measured, iterations=max(side // 128, 1))
    return Case(name, truth, seen, measured & (weight == 0), measured & (weight > 0.99))


def degraded(case: Case, blur: float = 2.0, noise: float = 0.03, seed: int = 0) -> Case:
    """The same, but what is seen is blurred (texels) and noisy (of sRGB's 1), as a poor photo."""
    seen = case.seen
    generator = np.random.default_rng(seed)
    weight = seen.weight[..., None]
    smooth = gaussian_filter(seen["photo"] * weight, (blur, blur, 0))
    smooth /= np.maximum(gaussian_filter(weight, (blur, blur, 0)), 1e-3)
    grain = generator.standard_normal(seen["photo"].shape) * noise
    photo = np.clip(smooth + grain, 0, 1).astype(np.float32)
    poor = seen.maps["photo"]._replace(values=np.where(weight > 0, photo, seen["photo"]))
    return replace(case, seen=replace(seen, maps=seen.maps.with_maps(photo=poor)))
