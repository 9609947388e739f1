"""A picture of a mesh: projection, rasterisation, interpolation and shading in one call."""

import equinox as eqx
import jax.numpy as jnp

from jaxface._numerics import safe_normalize
from jaxface._types import Array, Bool, Float, Int
from jaxface.geometry.camera import Camera, Pose
from jaxface.geometry.mesh import vertex_normals
from jaxface.render.interpolate import interpolate
from jaxface.render.rasterize import Fragments, rasterize
from jaxface.render.shading import irradiance


class RenderedImage(eqx.Module):
    """A picture and what it was made from."""

    color: Float[Array, "h w 3"]
    """linear-light RGB"""
    mask: Bool[Array, "h w"]
    """True where the mesh is seen"""
    fragments: Fragments
    normals: Float[Array, "h w 3"]
    """unit normals in the camera's frame, zero on the background"""


def render(
    vertices: Float[Array, "n 3"],
    albedo: Float[Array, "n 3"],
    faces: Int[Array, "f 3"],
    pose: Pose,
    camera: Camera,
    light: Float[Array, "9 3"],
    height: int,
    width: int,
    background: Float[Array, "3"] | Float[Array, "h w 3"] | float = 0.0,
    *,
    cull: bool = False,
) -> RenderedImage:
    """The mesh in a Lambertian picture, ``albedo * H(n) L`` at every pixel.

    Smooth normals (area-weighted, interpolated, renormalised) are taken in the camera's frame,
    where the light lives. Differentiable in vertices, albedo, pose, camera and light for fixed
    visibility: exact inside silhouettes, blind to their motion.

    Args:
        vertices: in the model's frame, mm.
        albedo: linear RGB of each vertex.
        faces: triangles, counter-clockwise seen from outside.
        pose: model to camera frame.
        camera: the projection.
        light: shading coefficients in the camera's frame (see ``shading``).
        height: rows of the picture.
        width: columns of the picture.
        background: linear RGB behind the mesh, a colour or a picture.
        cull: drop triangles seen from behind.

    Raises:
        ValueError: from ``rasterize``, if the picture is empty or shapes do not fit.
    """
    placed = pose(vertices)
    fragments = rasterize(camera.project(placed), faces, height, width, cull=cull)
    at_pixels = interpolate(
        jnp.concatenate([albedo, vertex_normals(placed, faces)], axis=1), faces, fragments
    )
    normals = safe_normalize(at_pixels[..., 3:])
    shaded = at_pixels[..., :3] * irradiance(normals, light)
    mask = fragments.mask
    color = jnp.where(mask[..., None], shaded, jnp.asarray(background, shaded.dtype))
    return RenderedImage(color, mask, fragments, normals)
