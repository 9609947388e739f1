"""Fitted face -> texture: the partial albedo and a whole one to look at."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Float
from jaxface.geometry.uv import uv_layout
from jaxface.pipeline.fitting import FittedFace
from jaxface.stages.fit import fit_hidden_shading
from jaxface.stages.unwrap import PartialAlbedo, complete_preview, unwrap


@dataclass(frozen=True)
class Texture:
    """What the photo shows of the albedo, and a whole texture over the model's own."""

    partial: PartialAlbedo
    whole: Float[Array, "r r 3"]
    """linear RGB, nowhere empty; the model's low-frequency albedo where the photo shows nothing"""


def texture(fitted: FittedFace, resolution: int = 2048) -> Texture:
    """The partial albedo of a fit in UV (Saito 2017, section 3), from the photo's own pixels.

    Args:
        fitted: the fit.
        resolution: texels along a side.
    """
    clock, crop, data = fitted.clock, fitted.working.crop, fitted.working.data
    y, model = fitted.parameters, fitted.model
    layout = clock.host("uv layout", uv_layout, model.uv, model.uv_faces, resolution)
    height, width = fitted.photo.shape[:2]
    corner = np.floor(np.maximum(crop.origin, 0)).astype(int)
    end = np.ceil(np.minimum(crop.origin + crop.side, [width, height])).astype(int)
    cut = fitted.photo[corner[1] : end[1], corner[0] : end[0]]
    # A whole number of 64 px blocks, so that photos of similar size share one program.
    fill = [(0, -n % 64) for n in cut.shape[:2]]
    cut = np.pad(cut, (*fill, (0, 0)), mode="edge")
    camera = y.camera(data.principal, crop.side).cropped(jnp.asarray(corner - crop.origin))
    mask = _mask_on(cut.shape[:2], corner, crop, fitted)
    partial = clock.host(
        "unwrap", lambda: jax.block_until_ready(unwrap(
            jnp.asarray(cut * fitted.working.gain), jnp.asarray(mask),
            y.pose(fitted.vertices), model.faces, camera, y.light, layout,
            fit_hidden_shading(y, model),
        )),
    )  # fmt: skip
    whole = clock.host(
        "fill texture", lambda: jax.block_until_ready(
            complete_preview(partial, model.reflectance(y.albedo), model.faces, layout)
        ),
    )  # fmt: skip
    return Texture(partial, whole)


def _mask_on(shape: tuple[int, int], corner: np.ndarray, crop: Any, fitted: FittedFace):
    """Pixels of a cut of the photo that show skin: the fit's mask less hair, hands, glasses."""
    mask = fitted.skin_map()
    ys, xs = np.mgrid[: shape[0], : shape[1]]
    at = (np.stack([xs, ys], axis=-1) + 0.5 + corner - crop.origin) / crop.side * len(mask)
    index = np.clip(at.astype(int), 0, len(mask) - 1)
    inside = ((at >= 0) & (at < len(mask))).all(axis=-1)
    return np.where(inside, mask[index[..., 1], index[..., 0]], 0.0).astype(np.float32)
