"""A texture seen in the mirror: what one half of a face says of the other.

The complexion of both halves is nearly the same: where one is hidden, the other's is the best guess
of its low frequencies (``with_other_side``). For a database's texture, which is to be whole, the
detail is taken over too (``fill_from_mirror``).
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from jaxface._types import Array, Float
from jaxface.geometry.uv import UVLayout
from jaxface.imaging.resample import bilinear
from jaxface.models.morphable import MorphableModel

GUESS = 0.5
"""trust in the other half's colour, of that in the half's own"""

ROWS = 128
"""of a texture that are computed at once"""


def mirror_uv(model: MorphableModel, layout: UVLayout) -> Float[np.ndarray, "r r 2"]:
    """Texture coordinates of the mirror image of every texel; NaN where there is none.

    The mirror is the plane x = 0 of the mean face. Each triangle is paired with the nearest one
    to its mirror image, in whose plane the texel's mirrored point is expressed; neither the
    layout nor the triangulation needs to be symmetric.
    """
    faces, uv_faces = np.asarray(model.faces), np.asarray(model.uv_faces)
    corners = np.asarray(model.mean, np.float64)[faces]
    flip = np.array([-1.0, 1.0, 1.0])
    extent = np.sqrt(np.mean((corners - corners.mean(axis=1, keepdims=True)) ** 2))
    edge = corners[:, 1:] - corners[:, :1]
    normal = np.cross(edge[:, 0], edge[:, 1])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    # Normals keep the two sides of thin parts (lids, lips) apart.
    tree = KDTree(np.concatenate([corners.mean(axis=1), 2 * extent * normal], axis=1))
    image = np.concatenate([corners.mean(axis=1) * flip, 2 * extent * normal * flip], axis=1)
    partner = np.asarray(tree.query(image)[1])

    triangle = np.asarray(layout.triangle)
    uv = np.asarray(model.uv, np.float64)
    result = np.full((*triangle.shape, 2), np.nan, np.float32)

    def rows(part: slice) -> None:
        present = triangle[part] >= 0
        b, c = np.asarray(layout.barycentric[part], np.float64)[present].T
        own = triangle[part][present]
        other = partner[own]
        point = (corners[own, 0] + b[:, None] * edge[own, 0] + c[:, None] * edge[own, 1]) * flip
        first, second = edge[other, 0], edge[other, 1]
        offset = point - corners[other, 0]
        aa, ab, bb = (
            np.sum(p * q, axis=1) for p, q in ((first, first), (first, second), (second,) * 2)
        )
        oa, ob = np.sum(offset * first, axis=1), np.sum(offset * second, axis=1)
        determinant = np.maximum(aa * bb - ab * ab, 1e-12)
        # Beyond its partner's edge a point is on a neighbour; farther it has no partner.
        weights = [(bb * oa - ab * ob) / determinant, (aa * ob - ab * oa) / determinant]
        on_b, on_c = (np.clip(w, -1.0, 2.0)[:, None] for w in weights)
        at = uv[uv_faces[other]]
        found = at[:, 0] * (1 - on_b - on_c) + at[:, 1] * on_b + at[:, 2] * on_c
        near = np.abs(weights[0] - 0.5) + np.abs(weights[1] - 0.5) < 3.0
        result[part][present] = np.where(near[:, None], found, np.nan)

    for start in range(0, len(triangle), ROWS):  # some at a time: two dozen arrays are in use
        rows(slice(start, start + ROWS))
    return result


@jax.jit
def mirrored(
    values: Float[Array, "r r c"], weight: Float[Array, "r r"], source_uv: Float[Array, "r r 2"]
) -> Float[Array, "r r d"]:
    """What a texture's mirror image shows: values times weight, and the weight, 0 where nothing.

    Args:
        values: anything where ``weight`` is 0.
        weight: how far each texel is to be trusted, 0 to 1.
        source_uv: from ``mirror_uv``.

    Returns:
        One channel more than ``values`` has, premultiplied.
    """
    both = jnp.concatenate([values * weight[..., None], weight[..., None]], axis=-1)
    size = weight.shape[0]

    def row(uv: Float[Array, "r 2"]) -> Float[Array, "r d"]:
        known = jnp.all(jnp.isfinite(uv), axis=-1)[:, None]
        place = jnp.where(known, uv, 0.0)
        points = jnp.stack([place[:, 0], 1.0 - place[:, 1]], axis=-1) * size
        return bilinear(both, points) * known

    return jax.lax.map(row, source_uv, batch_size=ROWS)


def with_other_side(
    albedo: Float[Array, "r r 3"], weight: Float[Array, "r r"], source_uv: Float[Array, "r r 2"]
) -> tuple[Float[Array, "r r 3"], Float[Array, "r r"]]:
    """A partial albedo and its weight, the other half's where a half is hidden.

    For low frequencies alone: a copy of the other half's detail would be seen.

    Args:
        albedo: linear RGB, anything where ``weight`` is 0.
        weight: how far each texel is to be trusted, 0 to 1.
        source_uv: from ``mirror_uv``.

    Returns:
        Colours, and weights that are at most `GUESS` where the other half speaks.
    """
    other = mirrored(albedo, weight, source_uv)
    guess = GUESS * (1 - weight)
    # ``other`` is premultiplied: colour times the weight that the other half has there.
    total = weight + guess * other[..., 3]
    colour = albedo * weight[..., None] + guess[..., None] * other[..., :3]
    return colour / jnp.maximum(total, 1e-6)[..., None], total


def fill_from_mirror(
    albedo: Float[Array, "r r 3"],
    weight: Float[Array, "r r"],
    low_frequency: Float[Array, "r r 3"],
    source_uv: Float[Array, "r r 2"],
) -> tuple[Float[Array, "r r 3"], Float[Array, "r r"]]:
    """A whole texture: what is seen, else what its mirror image shows, else the low frequencies.

    Of the mirror image the detail is taken over, the ratio to its own low frequencies, so that
    the two halves may differ in tone.

    Args:
        albedo: partial, linear RGB.
        weight: how far each texel is to be trusted, 0 to 1.
        low_frequency: whole, linear RGB.
        source_uv: from ``mirror_uv``.

    Returns:
        Linear RGB, and the weight of the mirror image in it.
    """
    detail = jnp.clip(albedo / jnp.maximum(low_frequency, 1e-4), 1 / 3, 3.0)
    found = mirrored(detail, weight, source_uv)
    trust = jnp.clip(found[..., 3], 0.0, 1.0)
    other = found[..., :3] / jnp.maximum(found[..., 3:], 1e-3)
    filled = low_frequency * (1 + trust[..., None] * (other - 1))
    seen = weight[..., None]
    return seen * albedo + (1 - seen) * filled, (1 - weight) * trust
