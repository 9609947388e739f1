"""What one side of a face says of the other: a texture seen in the face's plane of symmetry.

The complexion of both sides is nearly the same. Where one side is hidden, the other's is the best
guess of its low frequencies; detail is left to synthesis, for a copy of it would be seen.
"""

import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from jaxface._types import Array, Float
from jaxface.geometry.uv import UVLayout
from jaxface.imaging.resample import bilinear
from jaxface.models.morphable import MorphableModel

GUESS = 0.5
"""trust in the other side's colour, of that in the side's own"""

TOLERANCE = 0.02
"""of the model's width: a vertex that has no partner so near is not mirrored"""

LARGEST_TRIANGLE = 0.1
"""of the texture's side"""


def mirrored_texels(model: MorphableModel, layout: UVLayout) -> Float[np.ndarray, "r r 2"]:
    """Where the texture shows each texel's mirror image: (u, v) with the origin bottom-left.

    The mean shape is mirrored in the plane x = 0 of the model's frame; NaN where it has no partner.
    """
    mean = np.asarray(model.mean, np.float64)
    distance, partner = KDTree(mean).query(mean * [-1.0, 1.0, 1.0])
    uv = np.full((len(mean), 2), np.nan, np.float32)
    uv[np.asarray(model.faces).ravel()] = np.asarray(model.uv)[np.asarray(model.uv_faces).ravel()]
    target = uv[partner]
    target[distance > TOLERANCE * np.ptp(mean[:, 0])] = np.nan
    found = np.array(layout(jnp.asarray(target), model.faces, jnp.nan))
    # A triangle whose partner's corners lie on both sides of a seam has no place in the texture.
    torn = np.ptp(target[np.asarray(model.faces)], axis=1).max(-1) > LARGEST_TRIANGLE
    found[torn[np.maximum(np.asarray(layout.triangle), 0)]] = np.nan
    return found


def with_other_side(
    albedo: Float[Array, "r r 3"],
    weight: Float[Array, "r r"],
    model: MorphableModel,
    layout: UVLayout,
) -> tuple[Float[Array, "r r 3"], Float[Array, "r r"]]:
    """A partial albedo and its weight, the other side's where a side is hidden.

    Args:
        albedo: linear RGB, anything where ``weight`` is 0.
        weight: how far each texel is to be trusted.
        model: whose frame's plane x = 0 is the plane of symmetry.
        layout: the texture's layout.

    Returns:
        Colours, and weights that are at most `GUESS` where the other side speaks.
    """
    uv = mirrored_texels(model, layout)
    size = layout.resolution
    known = np.asarray(np.all(np.isfinite(uv), axis=-1))
    at = np.where(known[..., None], uv, 0.0)
    x, y = jnp.asarray(at[..., 0] * size), jnp.asarray((1.0 - at[..., 1]) * size)
    both = jnp.concatenate([albedo * weight[..., None], weight[..., None]], axis=-1)
    other = bilinear(both, jnp.stack([x, y], axis=-1))
    guess = GUESS * (1 - weight) * known
    # ``other`` is premultiplied: colour times the weight that the other side has there.
    total = weight + guess * other[..., 3]
    colour = albedo * weight[..., None] + guess[..., None] * other[..., :3]
    return colour / jnp.maximum(total, 1e-6)[..., None], total
