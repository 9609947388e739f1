"""Where skin may be darker than its surroundings, and where a photo shows no skin at all."""

import jax.numpy as jnp
import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter, minimum_filter

from jaxface._types import Array, Float
from jaxface.geometry.uv import UVLayout
from jaxface.imaging.masks import smoothstep
from jaxface.models.morphable import MorphableModel
from jaxface.models.skin.regions import skin_fields
from jaxface.stages.texture.charts import largest_part
from jaxface.stages.texture.mirror import mirrored

OTHER_BROW = 0.1
"""by which one brow may be darker than the other, natural logarithm of the albedo"""


def off_openings(
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


def may_be_dark(
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
    outline = np.asarray(distance_transform_edt(~largest_part(weight < 0.05)))
    hair = 3.0 * wide * np.clip((outline / step - 1.5) / 3, 0, 1)
    # One brow is about as dark as the other: what is darker by far is that hair's, or shadow.
    tone = ratio - np.average(ratio, weights=np.maximum(weight, 1e-6))
    seen = mirrored(jnp.asarray(tone[..., None]), jnp.asarray(weight, jnp.float32), source)
    sums, share = (gaussian_filter(np.asarray(seen)[..., k], step / 2) for k in (0, 1))
    other = -minimum_filter(sums / np.maximum(share, 0.1), round(3 * step))
    known = np.clip(2 * share - 0.5, 0, 1)
    darkest = known * np.maximum(other, 0) + (1 - known) * hair
    return np.minimum(hair, gaussian_filter(darkest, step) + OTHER_BROW)
