"""A picture of a mesh: projection, rasterisation, interpolation and shading in one call."""

import equinox as eqx
import jax.numpy as jnp

from jaxface._numerics import safe_normalize
from jaxface._types import Array, Bool, Float, Int
from jaxface.geometry.camera import Camera, Pose
from jaxface.geometry.mesh import vertex_normals
from jaxface.geometry.rotation import rotation_matrix
from jaxface.imaging.mipmap import Mipmap
from jaxface.render._interpolate import interpolate
from jaxface.render._rasterize import Fragments, rasterize
from jaxface.render.occlusion import hidden_shading
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
    return _over(background, shaded, fragments, normals)


def render_textured(
    vertices: Float[Array, "n 3"],
    faces: Int[Array, "f 3"],
    texture: Mipmap,
    uv: Float[Array, "m 2"],
    uv_faces: Int[Array, "f 3"],
    pose: Pose,
    camera: Camera,
    light: Float[Array, "9 3"],
    height: int,
    width: int,
    background: Float[Array, "3"] | Float[Array, "h w 3"] | float = 0.0,
    *,
    occlusion: Float[Array, "n 9"] | None = None,
    cull: bool = False,
) -> RenderedImage:
    """The mesh with an albedo texture: ``render`` with a colour for each pixel, not each vertex.

    The texture is read at the level of its mipmap on which a texel is as large as a pixel, by the
    areas of the seen triangle in both (Heckbert, "Texture mapping polygons in perspective", 1983,
    with one footprint a triangle). Differentiable in the texture too.

    Args:
        vertices: in the model's frame, mm.
        faces: triangles, counter-clockwise seen from outside.
        texture: linear RGB, row 0 at the top.
        uv: texture coordinates, origin at the bottom left.
        uv_faces: their corners, one row for each of ``faces``.
        pose: model to camera frame.
        camera: the projection.
        light: shading coefficients in the camera's frame (see ``shading``).
        height: rows of the picture.
        width: columns of the picture.
        background: linear RGB behind the mesh, a colour or a picture.
        occlusion: what the mesh hides from itself of the light, see ``occlusion``; None for
            nothing.
        cull: drop triangles seen from behind.

    Raises:
        ValueError: from ``rasterize``, if the picture is empty or shapes do not fit.
    """
    placed = pose(vertices)
    screen = camera.project(placed)
    fragments = rasterize(screen, faces, height, width, cull=cull)
    size = jnp.array(texture.shapes[0][::-1], uv.dtype)
    texels = jnp.stack([uv[:, 0], 1 - uv[:, 1]], axis=-1) * size
    ratio = _areas(texels, uv_faces) / jnp.maximum(_areas(screen[:, :2], faces), 1e-6)
    level = 0.5 * jnp.log2(jnp.maximum(ratio, 1e-6))
    points = interpolate(texels, uv_faces, fragments).reshape(-1, 2)
    seen = jnp.where(fragments.mask, level[jnp.maximum(fragments.triangle, 0)], 0.0)
    albedo = texture.trilinear(points, seen.reshape(-1)).reshape(height, width, -1)
    hidden = jnp.zeros_like(placed)
    if occlusion is not None:
        hidden = hidden_shading(occlusion, rotation_matrix(pose.rotation), light)
    at_pixels = interpolate(
        jnp.concatenate([vertex_normals(placed, faces), hidden], axis=1), faces, fragments
    )
    normals = safe_normalize(at_pixels[..., :3])
    shaded = albedo * (irradiance(normals, light) + at_pixels[..., 3:])
    return _over(background, shaded, fragments, normals)


def _areas(points: Float[Array, "n 2"], faces: Int[Array, "f 3"]) -> Float[Array, "f"]:
    """Twice the area of each triangle."""
    a, b, c = (points[faces[:, i]] for i in range(3))
    (x, y), (u, v) = (b - a).T, (c - a).T
    return jnp.abs(x * v - y * u)


def _over(
    background: Float[Array, "..."] | float,
    shaded: Float[Array, "h w 3"],
    fragments: Fragments,
    normals: Float[Array, "h w 3"],
) -> RenderedImage:
    mask = fragments.mask
    color = jnp.where(mask[..., None], shaded, jnp.asarray(background, shaded.dtype))
    return RenderedImage(color, mask, fragments, normals)
