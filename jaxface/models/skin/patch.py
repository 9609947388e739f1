"""A run of texels with everything a layer of skin needs to know about them."""

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxface._types import Array, Float, Int
from jaxface.models.skin.regions import Regions, SkinFields
from jaxface.models.skin.rows import Row, Vector, unit


class SkinPatch(eqx.Module):
    """Points of the surface, one a texel."""

    position: Vector
    """mm, on the model's mean face"""
    normal: Vector
    tension: Vector
    hair: Vector
    regions: Regions
    texel: Row
    """size of a texel (mm)"""
    landmarks: Float[Array, "68 3"]
    """mm"""


def patch_at(
    fields: SkinFields,
    base: Float[Array, "v 3"],
    faces: Int[Array, "f 3"],
    triangle: Int[Array, "n"],
    barycentric: Float[Array, "n 2"],
    resolution: int,
) -> tuple[SkinPatch, Vector]:
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
    # Once in memory, row by row; else every layer would gather again.
    values = jax.lax.optimization_barrier(rows.T)

    def vector(start: int) -> Vector:
        return values[start], values[start + 1], values[start + 2]

    patch = SkinPatch(
        position=vector(0),
        normal=unit(vector(3)),
        tension=unit(vector(6)),
        hair=unit(vector(9)),
        regions=Regions(**{name: values[16 + i] for i, name in enumerate(names)}),
        texel=values[15] / resolution,
        landmarks=fields.landmarks,
    )
    return jax.lax.optimization_barrier(patch), vector(12)
