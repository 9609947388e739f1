"""Fitted face -> texture: the partial albedo and a whole one to look at."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxface._compilation import quick_jit
from jaxface._types import Array, Float
from jaxface.geometry.uv import UVLayout, uv_layout
from jaxface.pipeline.fitting.fitted_face import FittedFace
from jaxface.run.clock import Clock
from jaxface.stages._unwrap import PartialAlbedo, unwrap
from jaxface.stages.fit import fit_hidden_shading
from jaxface.stages.texture.low_frequency import low_frequency_albedo, over_low_frequency

_hidden_shading = quick_jit(fit_hidden_shading)


@dataclass(frozen=True)
class Texture:
    """What the photo shows of the albedo, and a whole texture over the model's own."""

    partial: PartialAlbedo
    low_frequency: Float[Array, "r r 3"]
    """linear RGB: the model's albedo with the complexion that the photo shows"""
    whole: Float[Array, "r r 3"]
    """linear RGB, nowhere empty: the partial albedo over the low-frequency one"""
    texels_per_pixel: float
    """texels along a side of what one pixel of the photo covers, over what is well seen"""


def texture(fitted: FittedFace, resolution: int = 2048, *, clock: Clock | None = None) -> Texture:
    """The partial albedo of a fit in UV (Saito 2017, section 3), from the photo's own pixels.

    Args:
        fitted: the fit.
        resolution: texels along a side.
        clock: where times are noted.
    """
    clock, crop, data = clock or Clock(), fitted.working.crop, fitted.working.data
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
    mask = _mask_on(cut.shape[:2], corner, crop, fitted.skin_map(clock))
    partial = clock.host(
        "unwrap", lambda: jax.block_until_ready(unwrap(
            jnp.asarray(cut * fitted.working.gain), jnp.asarray(mask),
            y.pose(fitted.vertices), model.faces, camera, y.light, layout,
            _hidden_shading(y, model),
        )),
    )  # fmt: skip
    low = clock.host(
        "low frequencies", lambda: jax.block_until_ready(low_frequency_albedo(
            partial.albedo, partial.weight, model.reflectance(y.albedo), model.faces, layout
        )),
    )  # fmt: skip
    whole = over_low_frequency(partial.albedo, partial.weight, low)
    return Texture(partial, low, whole, _texels_per_pixel(fitted, partial, layout))


def _texels_per_pixel(fitted: FittedFace, partial: PartialAlbedo, layout: UVLayout) -> float:
    """Root of texels over pixels of the photo, the mean over the texels of full weight."""
    y, side = fitted.parameters, fitted.working.crop.side
    camera = y.camera(fitted.working.data.principal, side)
    corners = np.asarray(camera.project(y.pose(fitted.vertices)))[
        np.asarray(fitted.model.faces), :2
    ]
    edges = corners[:, 1:] - corners[:, :1]
    pixels = 0.5 * np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0])
    triangle = np.asarray(layout.triangle)[np.asarray(partial.weight) > 0.8]
    triangle = triangle[(triangle >= 0) & (pixels[triangle] > 0)]
    if not len(triangle):
        return 1.0
    return float(np.sqrt(np.mean(np.asarray(layout.area)[triangle] / pixels[triangle])))


def _mask_on(
    shape: tuple[int, int], corner: np.ndarray, crop: Any, mask: Float[np.ndarray, "s s"]
) -> Float[np.ndarray, "h w"]:
    """Pixels of a cut of the photo that show skin: the fit's mask less hair, hands, glasses."""
    ys, xs = np.mgrid[: shape[0], : shape[1]]
    at = (np.stack([xs, ys], axis=-1) + 0.5 + corner - crop.origin) / crop.side * len(mask)
    index = np.clip(at.astype(int), 0, len(mask) - 1)
    inside = ((at >= 0) & (at < len(mask))).all(axis=-1)
    return np.where(inside, mask[index[..., 1], index[..., 0]], 0.0).astype(np.float32)
