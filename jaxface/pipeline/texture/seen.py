"""What one photo shows of a face's albedo, as the completion needs it."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxface._types import Float
from jaxface.geometry.uv import uv_layout
from jaxface.imaging.resample import resize
from jaxface.io.face_models import load_model
from jaxface.io.face_models.model_file import bundled_models
from jaxface.io.fit_file import SavedFit, read_fit
from jaxface.io.formats.exr import read_exr, srgb_encoded
from jaxface.models.maps import UVMap, UVMaps, uv_digest
from jaxface.models.morphable import MorphableModel
from jaxface.models.opening_rims import opening_rims
from jaxface.models.subdivide import subdivide
from jaxface.stages.texture._plausible_skin import plausible_skin
from jaxface.stages.texture.charts import charts
from jaxface.stages.texture.dark_places import may_be_dark, off_openings
from jaxface.stages.texture.low_frequency import low_frequency_albedo
from jaxface.stages.texture.mirror import mirror_uv, with_other_side

SMALLEST = 256
"""texels along a side at least"""


@dataclass(frozen=True, eq=False)
class SeenTexture:
    """Maps in the model's UVs, row 0 at the top; colours are sRGB-encoded.

    By kind: ``photo``, the partial albedo with its weight; ``low_frequency``; ``free``, skin of the
    face, to be synthesised; ``skin``, all skin in the charts; ``inside``, the charts; ``plain``, 1
    on bare skin, 0 on brows, lids, lips, in nostrils and beards; ``vertex``, one of each texel's
    triangle.
    """

    model: MorphableModel
    maps: UVMaps
    texels_per_pixel: float
    """texels along a side of what one pixel of the photo covers, the median over what is seen"""

    def __getitem__(self, kind: str) -> np.ndarray:
        """The values of a map."""
        return np.asarray(self.maps[kind].values)

    @property
    def weight(self) -> Float[np.ndarray, "r r"]:
        """How far each texel of ``photo`` is to be trusted."""
        weight = self.maps["photo"].weight
        return (
            np.ones(self.maps["photo"].values.shape[:2], np.float32) if weight is None else weight
        )

    @property
    def resolution(self) -> int:
        """Texels along a side."""
        return self.maps.resolution

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
        return values[np.asarray(self.model.region)[self["vertex"]]]


def seen_texture(
    model: MorphableModel,
    albedo: Float[np.ndarray, "r r 3"],
    weight: Float[np.ndarray, "r r"],
    coefficients: Float[np.ndarray, "a"],
    texels_per_pixel: float,
    *,
    plausible: bool = True,
    whole: bool = False,
) -> SeenTexture:
    """From a partial albedo (linear RGB) and the albedo coefficients of a fit.

    Args:
        model: with the UVs of the albedo.
        albedo: partial, linear RGB.
        weight: how far each texel is to be trusted.
        coefficients: of the fit's albedo, standard deviations.
        texels_per_pixel: texels along a side of what one pixel of the photo covers.
        plausible: take out what is no skin and continue the complexion; False, as in the paper: the
            partial albedo as it is, and the model's own albedo as low frequencies.
        whole: the whole map is to be synthesised, as in the paper, not only the face's skin.

    Raises:
        ValueError: the texture is smaller than 256 texels along a side, or not square.
    """
    size = len(albedo)
    if albedo.shape != (size, size, 3) or weight.shape != (size, size) or size < SMALLEST:
        raise ValueError(
            f"the partial albedo is {albedo.shape[:2]}, its weight {weight.shape}; both need to be "
            f"square, {SMALLEST} texels or more"
        )
    layout = uv_layout(model.uv, model.uv_faces, size)
    shown = charts(model, layout)
    if plausible:
        rims = opening_rims(model)
        calm = rims.calm(model.reflectance(jnp.asarray(coefficients)))
        base = layout(calm, model.faces)
        weight = np.asarray(weight) * off_openings(
            model, np.asarray(rims.pocket), layout, texels_per_pixel
        )
        source = jnp.asarray(mirror_uv(model, layout))
        dark = may_be_dark(model, layout, np.asarray(albedo), weight, np.asarray(base), source)
        kept, trusted = plausible_skin(
            jnp.asarray(albedo), jnp.asarray(weight), base, jnp.asarray(dark)
        )
        low = low_frequency_albedo(
            *with_other_side(kept, trusted, source), calm, model.faces, layout
        )
        plain = np.asarray(1 - np.clip(dark / 0.15, 0, 1), np.float32)
    else:
        own = model.reflectance(jnp.asarray(coefficients))
        low = layout(own, model.faces)
        low = jnp.where((layout.triangle < 0)[..., None], jnp.mean(own, axis=0), low)
        kept, trusted, plain = albedo, weight, np.ones((size, size), np.float32)
    everywhere = np.ones((size, size), bool)
    maps = {
        "photo": UVMap(
            srgb_encoded(np.asarray(kept)), encoding="srgb", weight=np.asarray(trusted, np.float32)
        ),
        "low_frequency": UVMap(srgb_encoded(np.asarray(low)), encoding="srgb"),
        "free": UVMap(everywhere if whole else shown.face),
        "skin": UVMap(everywhere if whole else shown.skin),
        "inside": UVMap(shown.inside),
        "plain": UVMap(plain),
        "vertex": UVMap(shown.vertex, unit="index"),
    }
    return SeenTexture(model, UVMaps(uv_digest(model), maps), texels_per_pixel)


def fitted_model(
    place: Path, saved: SavedFit, model: str | os.PathLike[str] | MorphableModel | None = None
) -> MorphableModel:
    """The model that a folder's fit is of.

    Args:
        place: the folder, for messages.
        saved: its fit.
        model: the model or its file, where it is not a bundled one.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged, or the model is another one.
    """
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


def read_folder_fit(folder: str | os.PathLike[str]) -> SavedFit:
    """The fit in a folder that `save_fit` wrote.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is damaged.
    """
    return read_fit(_part(Path(folder), "fit.npz"))


def read_seen_texture(
    folder: str | os.PathLike[str],
    resolution: int | None = None,
    model: str | os.PathLike[str] | MorphableModel | None = None,
    *,
    saved: SavedFit | None = None,
    plausible: bool = True,
    whole: bool = False,
) -> SeenTexture:
    """From a folder that `save_fit` wrote.

    Args:
        folder: with ``fit.npz`` and ``albedo_partial.exr``.
        resolution: texels along a side; as the partial albedo has by default.
        model: the model or its file, where it is not a bundled one.
        saved: the fit, where it is read already.
        plausible: see `seen_texture`.
        whole: likewise.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a file is damaged, or of another model.
    """
    place = Path(folder)
    saved = saved or read_folder_fit(place)
    face = fitted_model(place, saved, model)
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
        finer, albedo, weight[..., 0], np.asarray(saved.parameters.albedo), scale * len(albedo),
        plausible=plausible, whole=whole,
    )  # fmt: skip


def _part(place: Path, name: str) -> Path:
    if not (place / name).is_file():
        raise FileNotFoundError(f"{place} has no {name}; `jaxface digitize` writes it")
    return place / name
