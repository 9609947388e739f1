"""A run of texels with everything a layer of skin needs to know about them."""

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxface._types import Array, Float, Int
from jaxface.models.skin.regions import Regions, SkinFields


class SkinPatch(eqx.Module):
    """Points of the surface, one a texel; vectors are three rows."""

    position: Float[Array, "3 n"]
    """mm, on the model's mean face"""
    normal: Float[Array, "3 n"]
    tension: Float[Array, "3 n"]
    hair: Float[Array, "3 n"]
    regions: Regions
    texel: Float[Array, "n"]
    """size of a texel (mm)"""


def patch_at(
    fields: SkinFields,
    base: Float[Array, "v 3"],
    faces: Int[Array, "f 3"],
    triangle: Int[Array, "n"],
    barycentric: Float[Array, "n 2"],
    resolution: int,
) -> tuple[SkinPatch, Float[Array, "3 n"]]:
    """Interpolate the fields, and a base albedo, at texels of a UV layout.

    Args:
        fields: of the model.
        base: albedo per vertex (linear RGB).
        faces: the model's triangles.
        triangle: the triangle each texel shows (not negative).
        barycentric: weights of its second and third corner.
        resolution: texels along a side of the texture.
    """
    names = list(vars(fields.regions))
    regions = [getattr(fields.regions, name)[:, None] for name in names]
    vectors = [fields.position, fields.normal, fields.tension, fields.hair, base]
    table = jnp.concatenate([*vectors, fields.spacing[:, None], *regions], axis=1)
    corners = faces[triangle]
    b, c = barycentric[:, 0:1], barycentric[:, 1:2]
    rows = table[corners[:, 0]] * (1 - b - c) + table[corners[:, 1]] * b + table[corners[:, 2]] * c
    values = jax.lax.optimization_barrier(rows.T)
    patch = SkinPatch(
        position=values[0:3],
        normal=_unit(values[3:6]),
        tension=_unit(values[6:9]),
        hair=_unit(values[9:12]),
        regions=Regions(**{name: values[16 + i] for i, name in enumerate(names)}),
        texel=values[15] / resolution,
    )
    return patch, values[12:15]


def _unit(vector: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
    return vector * jax.lax.rsqrt(jnp.maximum(jnp.sum(vector * vector, axis=0), 1e-12))
