"""Textures from other layouts and other meshes into a model's UVs."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxface._numerics import safe_norm
from jaxface._types import Array, Bool, Float
from jaxface.geometry.closest_point import TriangleTree
from jaxface.geometry.uv import UVLayout
from jaxface.imaging.mipmap import Mipmap, mipmap
from jaxface.imaging.push_pull import push_pull
from jaxface.imaging.resample import bilinear
from jaxface.models.morphable import MorphableModel
from jaxface.models.skin.regions import skin_fields
from jaxface.stages.scan.register import RegisteredScan


class TransferredTexture(NamedTuple):
    """A texture in the model's UVs."""

    texture: Float[Array, "r r c"]
    """in the source's units, 0 where unknown"""
    known: Float[Array, "r r"]
    """1 where the source shows the texel, 0 where not, between at its edge"""


def resample_texture(
    source: Float[Array, "h w c"],
    source_known: Bool[Array, "h w"],
    source_uv: Float[Array, "r r 2"],
    layout: UVLayout,
) -> TransferredTexture:
    """Look up a source texture at the coordinates where it shows each texel of a layout.

    Trilinear in a mipmap, whose level follows how far apart neighbouring texels look; across a
    seam of the source neighbours look at far places, so the smaller of both sides counts.

    Args:
        source: the texture, row 0 at the top.
        source_known: which of its texels say something.
        source_uv: where to look (origin bottom-left); NaN where nowhere.
        layout: of the target.
    """
    height, width = source_known.shape
    inside = (layout.triangle >= 0) & jnp.all(jnp.isfinite(source_uv), axis=-1)
    place = jnp.where(inside[..., None], source_uv, 0.0)
    points = jnp.stack([place[..., 0] * width, (1.0 - place[..., 1]) * height], axis=-1)

    def step(axis: int) -> Float[Array, "r r"]:
        ahead = safe_norm(jnp.roll(points, -1, axis) - points)
        ahead = jnp.where(inside & jnp.roll(inside, -1, axis), ahead, jnp.inf)
        least = jnp.minimum(ahead, jnp.roll(ahead, 1, axis))
        return jnp.where(jnp.isfinite(least), least, 1.0)

    level = jnp.log2(jnp.maximum(jnp.maximum(step(0), step(1)), 1e-3))
    weight = source_known.astype(source.dtype)[..., None]
    pyramid: Mipmap = mipmap(jnp.concatenate([source * weight, weight], axis=-1))
    values = pyramid.trilinear(points.reshape(-1, 2), level.reshape(-1))
    values = values.reshape(*layout.triangle.shape, -1)
    known = values[..., -1] * inside
    sound = known > 0.5
    texture = jnp.where(sound[..., None], values[..., :-1] / jnp.maximum(known, 0.5)[..., None], 0)
    return TransferredTexture(texture, jnp.where(sound, known, 0.0))


def surface_uv(
    registered: RegisteredScan, model: MorphableModel, layout: UVLayout, reach: float = 3.0
) -> Float[np.ndarray, "r r 2"]:
    """Where in a scan's maps each texel of a model lies, by the scan's closest point to it.

    Args:
        registered: the scan.
        model: the topology.
        layout: of the model.
        reach: mm; texels farther from the scan are unknown.

    Returns:
        Texture coordinates of the scan; NaN where it shows nothing.
    """
    scan = registered.scan
    at = np.asarray(layout(jnp.asarray(registered.vertices, jnp.float32), model.faces, jnp.nan))
    shown = np.isfinite(at).all(-1)
    found = TriangleTree(registered.scan_vertices, scan.faces)(at[shown])
    corners = scan.uv[scan.uv_faces[found.triangle]]
    uv = np.einsum("qi,qid->qd", found.weights, corners)
    source_uv = np.full((*shown.shape, 2), np.nan, np.float32)
    source_uv[shown] = np.where(found.distance[:, None] < reach, uv, np.nan)
    return source_uv


def transfer_texture(
    registered: RegisteredScan,
    texture: Float[np.ndarray, "h w c"],
    model: MorphableModel,
    layout: UVLayout,
    reach: float = 3.0,
) -> TransferredTexture:
    """A map of the scan in the model's UVs, by the closest point of the scan to each texel.

    Args:
        registered: the scan.
        texture: any map in the scan's UVs (linear values).
        model: the topology.
        layout: of the model.
        reach: mm; texels farther from the scan are unknown.

    Returns:
        A `TransferredTexture`.
    """
    source_uv = surface_uv(registered, model, layout, reach)
    known = jnp.ones(texture.shape[:2], bool)
    return resample_texture(jnp.asarray(texture), known, jnp.asarray(source_uv), layout)


def complete_texture(
    transferred: TransferredTexture,
    elsewhere: Float[Array, "r r 3"],
    layout: UVLayout,
    skin: Float[Array, "r r"],
) -> Float[Array, "r r 3"]:
    """Fill what a source does not show.

    Skin continues the known skin around it; eyes and mouth are taken from ``elsewhere``; outside
    the islands everything continues.

    Args:
        transferred: linear RGB and where it is known.
        elsewhere: linear RGB of the model itself.
        layout: of both.
        skin: 1 on skin, 0 on eyes, teeth and gums.
    """
    known = transferred.known
    grown = _continued(transferred.texture, known * skin)
    texture = jnp.where((known > 0)[..., None], transferred.texture, grown)
    texture = texture * skin[..., None] + elsewhere * (1 - skin[..., None])
    present = (layout.triangle >= 0).astype(texture.dtype)
    return jnp.where(present[..., None] > 0, texture, _continued(texture, present))


def own_parts(
    model: MorphableModel, layout: UVLayout
) -> tuple[Float[Array, "r r 3"], Float[Array, "r r"]]:
    """What `complete_texture` takes from the model: its mean albedo, and where its skin is."""
    elsewhere = layout(jnp.clip(model.albedo_mean, 0.0, 1.0), model.faces)
    return elsewhere, layout(skin_fields(model).regions.skin[:, None], model.faces)[..., 0]


def whole_texture(
    found: TransferredTexture, model: MorphableModel, layout: UVLayout
) -> Float[Array, "r r 3"]:
    """A transferred texture (linear RGB) with eyes and mouth of the model, and no gaps."""
    elsewhere, skin = own_parts(model, layout)
    return complete_texture(found, elsewhere, layout, skin)


def _continued(texture: Float[Array, "r r c"], weight: Float[Array, "r r"]) -> Array:
    """Push-pull at 512 texels a side: what is made up needs no detail."""
    side = texture.shape[0]
    block = max(side // 512, 1) if side % 512 == 0 else 1
    share = weight.reshape(side // block, block, side // block, block).mean((1, 3))
    total = (texture * weight[..., None]).reshape(side // block, block, side // block, block, -1)
    mean = total.mean((1, 3)) / jnp.maximum(share, 1e-6)[..., None]
    filled = push_pull(mean, jnp.minimum(share * 4.0, 1.0))
    return jax.image.resize(filled, texture.shape, "linear")


def texel_colours(texture: Float[Array, "h w c"], uv: Float[Array, "n 2"]) -> Float[Array, "n c"]:
    """Bilinear values of a texture at texture coordinates (origin bottom-left)."""
    height, width = texture.shape[:2]
    points = jnp.stack([uv[:, 0] * width, (1.0 - uv[:, 1]) * height], axis=-1)
    return bilinear(texture, points)
