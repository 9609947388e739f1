"""What one photo shows of a face's albedo, as the completion needs it."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter, minimum_filter

from jaxface._types import Array, Bool, Float
from jaxface.geometry.uv import UVLayout, uv_layout
from jaxface.imaging.masks import smoothstep
from jaxface.imaging.resample import resize
from jaxface.io.face_models import load_model
from jaxface.io.face_models.model_file import bundled_models
from jaxface.io.fit_file import SavedFit, read_fit
from jaxface.io.formats.exr import read_exr, srgb_encoded
from jaxface.models.morphable import MorphableModel
from jaxface.models.opening_rims import opening_rims
from jaxface.models.regions import FACE_REGIONS, NOT_SKIN
from jaxface.models.skin.regions import skin_fields
from jaxface.models.subdivide import subdivide
from jaxface.stages.texture._plausible_skin import plausible_skin
from jaxface.stages.texture.low_frequency import low_frequency_albedo
from jaxface.stages.texture.mirror import mirror_uv, mirrored, with_other_side

SMALLEST = 256
"""texels along a side at least"""

OTHER_BROW = 0.1
"""by which one brow may be darker than the other, natural logarithm of the albedo"""


@dataclass(frozen=True)
class SeenTexture:
    """Maps in the model's UVs, row 0 at the top; colours are sRGB-encoded."""

    model: MorphableModel
    photo: Float[np.ndarray, "r r 3"]
    """partial albedo"""
    weight: Float[np.ndarray, "r r"]
    low_frequency: Float[np.ndarray, "r r 3"]
    texels_per_pixel: float
    """texels along a side of what one pixel of the photo covers, the median over what is seen"""
    free: Bool[np.ndarray, "r r"]
    """skin of the face, to be synthesised"""
    skin: Bool[np.ndarray, "r r"]
    """all skin, in the charts: not eyes, not the inside of the mouth"""
    inside: Bool[np.ndarray, "r r"]
    """the charts"""
    plain: Float[np.ndarray, "r r"]
    """1 on bare skin, 0 on brows, lids, lips, in nostrils and beards"""
    vertex_of: np.ndarray
    """(r, r) a vertex of each texel's triangle"""

    @property
    def resolution(self) -> int:
        """Texels along a side."""
        return len(self.photo)

    def detail_map(self, regions: Mapping[str, float]) -> Float[np.ndarray, "r r"]:
        """How much detail each texel may get, 1 where its region is not named.

        Raises:
            ValueError: the model has no such region, or a value is not in [0, 1].
        """
        values = np.ones(len(self.model.region_names) or 1, np.float32)
        for name, value in regions.items():
            if name not in self.model.region_names:
                raise ValueError(
                    f"the model has no region {name!r}; it has {list(self.model.region_names)}"
                )
            if not 0 <= value <= 1:
                raise ValueError(f"detail of {name!r} is {value}; it needs to be in [0, 1]")
            values[self.model.region_names.index(name)] = value
        return values[np.asarray(self.model.region)[self.vertex_of]]


def seen_texture(
    model: MorphableModel,
    albedo: Float[np.ndarray, "r r 3"],
    weight: Float[np.ndarray, "r r"],
    coefficients: Float[np.ndarray, "a"],
    texels_per_pixel: float,
) -> SeenTexture:
    """From a partial albedo (linear RGB) and the albedo coefficients of a fit.

    Raises:
        ValueError: the texture is smaller than 256 texels along a side, or not square.
    """
    size = len(albedo)
    if albedo.shape != (size, size, 3) or weight.shape != (size, size) or size < SMALLEST:
        raise ValueError(
            f"the partial albedo is {albedo.shape[:2]}, its weight {weight.shape}; both need to be "
            f"square, {SMALLEST} texels or more"
        )
    layout: UVLayout = uv_layout(model.uv, model.uv_faces, size)
    rims = opening_rims(model)
    calm = rims.calm(model.reflectance(jnp.asarray(coefficients)))
    base = layout(calm, model.faces)
    weight = np.asarray(weight) * _off_openings(
        model, np.asarray(rims.pocket), layout, texels_per_pixel
    )
    source = jnp.asarray(mirror_uv(model, layout))
    dark = _may_be_dark(model, layout, np.asarray(albedo), weight, np.asarray(base), source)
    kept, trusted = plausible_skin(
        jnp.asarray(albedo), jnp.asarray(weight), base, jnp.asarray(dark)
    )
    low = low_frequency_albedo(*with_other_side(kept, trusted, source), calm, model.faces, layout)
    triangle = np.maximum(np.asarray(layout.triangle), 0)
    faces = np.asarray(model.faces)
    inside = np.asarray(layout.inside)

    def within(*names: str) -> np.ndarray:
        known = [name for name in names if name in model.region_names]
        if not known:
            return np.zeros(size * size, bool).reshape(size, size)
        covered = np.all(np.asarray(model.region_mask(*known))[faces], axis=1)
        return np.asarray(covered)[triangle] & inside

    face = within(*FACE_REGIONS) if model.region_names else inside
    return SeenTexture(
        model=model,
        photo=srgb_encoded(np.asarray(kept)),
        weight=np.asarray(trusted, np.float32),
        low_frequency=srgb_encoded(np.asarray(low)),
        texels_per_pixel=texels_per_pixel,
        free=_largest_part(face),
        skin=inside & ~within(*NOT_SKIN),
        inside=inside,
        plain=np.asarray(1 - np.clip(dark / 0.15, 0, 1), np.float32),
        vertex_of=faces[triangle, 0],
    )


def model_of(
    folder: str | os.PathLike[str], model: str | os.PathLike[str] | MorphableModel | None = None
) -> MorphableModel:
    """The model that a folder's fit is of.

    Args:
        folder: that `save_fit` wrote.
        model: the model or its file, where it is not a bundled one.

    Raises:
        FileNotFoundError: there is no fit, or no such file.
        ValueError: the fit or the file is damaged, or the model is another one.
    """
    place = Path(folder)
    return _model_of(place, read_fit(_part(place, "fit.npz")), model)


def _model_of(
    place: Path, saved: SavedFit, model: str | os.PathLike[str] | MorphableModel | None
) -> MorphableModel:
    name = str(saved.metadata.get("model"))
    if model is None and name not in bundled_models():
        raise ValueError(f"{place} was fitted with model {name!r}; name its file with --model")
    face = model if isinstance(model, MorphableModel) else load_model(model or name)
    y = saved.parameters
    fitted = [y.identity.shape[0], y.expression.shape[0], y.albedo.shape[0]]
    own = [face.identity.count, face.expression.count, face.albedo.count]
    if face.name != name or fitted != own:
        raise ValueError(
            f"{place} was fitted with model {name!r} of {fitted} modes (identity, expression, "
            f"albedo), not with {face.name!r} of {own}"
        )
    return face


def read_seen_texture(
    folder: str | os.PathLike[str],
    resolution: int | None = None,
    model: str | os.PathLike[str] | MorphableModel | None = None,
) -> SeenTexture:
    """From a folder that `save_fit` wrote.

    Args:
        folder: with ``fit.npz`` and ``albedo_partial.exr``.
        resolution: texels along a side; as the partial albedo has by default.
        model: the model or its file, where it is not a bundled one.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a file is damaged, or of another model.
    """
    place = Path(folder)
    saved = read_fit(_part(place, "fit.npz"))
    face = _model_of(place, saved, model)
    partial = read_exr(_part(place, "albedo_partial.exr"))
    if partial.shape[2] != 4:
        raise ValueError(f"{place / 'albedo_partial.exr'} needs RGB and weight, 4 channels")
    if "texels_per_pixel" not in saved.arrays:
        raise ValueError(f"{place / 'fit.npz'} lacks texels_per_pixel; digitize the photo again")
    scale = float(saved.arrays["texels_per_pixel"]) / len(partial)
    albedo, weight = partial[..., :3], partial[..., 3:]
    if resolution is not None and resolution != len(partial):
        both = jnp.asarray(np.concatenate([albedo * weight, weight], axis=-1))
        sized = np.asarray(resize(both, resolution, resolution))
        albedo, weight = sized[..., :3] / np.maximum(sized[..., 3:], 1e-3), sized[..., 3:]
    # One refinement, as the fit's finest level has, so that the base colours are as smooth.
    finer = subdivide(face) if face.vertex_count < 20_000 else face
    return seen_texture(
        finer, albedo, weight[..., 0], np.asarray(saved.parameters.albedo), scale * len(albedo)
    )


def _part(place: Path, name: str) -> Path:
    if not (place / name).is_file():
        raise FileNotFoundError(f"{place} has no {name}; `jaxface digitize` writes it")
    return place / name


def _off_openings(
    model: MorphableModel,
    pockets: Float[np.ndarray, "n"],
    layout: UVLayout,
    texels_per_pixel: float,
) -> Float[np.ndarray, "r r"]:
    """0 within a pixel and a half of the photo of the eyes' and the mouth's openings, 1 elsewhere.

    Pixels there mix skin with teeth and eyeballs, and the smallest error of the fit makes them so.
    """
    pocket = pockets > 0
    if "mouth_interior" in model.region_names:
        pocket = pocket | np.asarray(model.region_mask("mouth_interior"))
    values = layout(jnp.asarray(pocket, jnp.float32)[:, None], model.faces, 0.0)
    opening = np.asarray(values)[..., 0] > 0
    if not opening.any():
        return np.ones(opening.shape, np.float32)
    margin = 1.5 * texels_per_pixel + layout.resolution / 512
    distance = np.asarray(distance_transform_edt(~opening))
    return np.asarray(smoothstep(distance, margin, 2 * margin), np.float32)


def _may_be_dark(
    model: MorphableModel,
    layout: UVLayout,
    albedo: Float[np.ndarray, "r r 3"],
    weight: Float[np.ndarray, "r r"],
    base: Float[np.ndarray, "r r 3"],
    source: Float[Array, "r r 2"],
) -> Float[np.ndarray, "r r"]:
    """How much darker than its surroundings skin may be, beyond what `plausible_skin` lets pass.

    Brows, where the model has them, lids, lips and nostrils; and the beard, if the photo shows one.
    """
    known = model.region_names
    smooth = np.zeros(model.vertex_count)
    for name, amount in (("eyelids", 0.25), ("lips", 0.3)):
        if name in known:
            smooth = smooth + amount * np.asarray(model.region_mask(name))
    if "nose" in known:
        nose, luma = np.asarray(model.region_mask("nose")), np.asarray(model.albedo_mean).mean(-1)
        smooth = smooth + 0.5 * nose * (luma < 0.7 * np.median(luma[nose]))
    if model.landmarks68 is not None:
        r = skin_fields(model).regions
        beard, cheek = (np.asarray(layout(x[:, None], model.faces, 0.0))[..., 0] * weight
                        for x in (r.beard, r.cheek))  # fmt: skip
        ratio = np.log(np.maximum(albedo, 1e-3) / np.maximum(base, 1e-3)).mean(-1)
        if beard.sum() > 0 and cheek.sum() > 0:
            darker = np.average(ratio, weights=cheek) - np.average(ratio, weights=beard)
            smooth = smooth + np.clip((darker - 0.1) / 0.25, 0, 1) * 0.8 * np.asarray(r.beard)
        hair = _brows(model, layout, ratio, weight, source)
    else:
        hair = 0.0
    return hair + np.asarray(layout(jnp.asarray(smooth[:, None]), model.faces, 0.0))[..., 0]


def _brows(
    model: MorphableModel,
    layout: UVLayout,
    ratio: Float[np.ndarray, "r r"],
    weight: Float[np.ndarray, "r r"],
    source: Float[Array, "r r 2"],
) -> Float[np.ndarray, "r r"]:
    """How much darker than skin brows may be, by the logarithm of albedo over the model's."""
    # Brows differ in height and width: wider than the model's own.
    brow = layout(skin_fields(model).regions.brow[:, None], model.faces, 0.0)
    step = layout.resolution / 128
    wide = np.clip(3 * gaussian_filter(np.asarray(brow)[..., 0], step), 0, 1)
    # At the outline of what is seen it is hair of the head that hangs in.
    outline = np.asarray(distance_transform_edt(~_largest_part(weight < 0.05)))
    hair = 3.0 * wide * np.clip((outline / step - 1.5) / 3, 0, 1)
    # One brow is about as dark as the other: what is darker by far is that hair's, or shadow.
    tone = ratio - np.average(ratio, weights=np.maximum(weight, 1e-6))
    seen = mirrored(jnp.asarray(tone[..., None]), jnp.asarray(weight, jnp.float32), source)
    sums, share = (gaussian_filter(np.asarray(seen)[..., k], step / 2) for k in (0, 1))
    other = -minimum_filter(sums / np.maximum(share, 0.1), round(3 * step))
    known = np.clip(2 * share - 0.5, 0, 1)
    darkest = known * np.maximum(other, 0) + (1 - known) * hair
    return np.minimum(hair, gaussian_filter(darkest, step) + OTHER_BROW)


def _largest_part(mask: Bool[np.ndarray, "r r"]) -> Bool[np.ndarray, "r r"]:
    """The largest connected part: lips and lids line mouth and eyes too, in charts of their own."""
    from skimage.measure import label

    parts = np.asarray(label(mask, connectivity=1))
    counts = np.bincount(parts.ravel())
    counts[0] = 0
    return parts == counts.argmax()
