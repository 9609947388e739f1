"""The partial high-frequency albedo (Saito 2017, section 3): the photo, unlit, in UV space.

Every texel is taken to its point on the fitted surface, the point to the photo, and the colour
found there is divided by the shading of the fitted light at the point's normal. What the photo
does not show well fades out by a smooth weight.
"""

import math
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxface._numerics import safe_normalize
from jaxface._types import Array, Bool, Float, Int, Shaped
from jaxface.geometry.camera import Camera
from jaxface.geometry.mesh import face_areas_normals, vertex_normals
from jaxface.geometry.uv import UVLayout
from jaxface.imaging.masks import feather, smoothstep
from jaxface.imaging.mipmap import Mipmap, mipmap
from jaxface.render.rasterize import rasterize
from jaxface.render.shading import irradiance

# A surface seen steeper than this (tangent of the angle to the view) counts as a depth jump.
_STEEPEST = 6.0


class PartialAlbedo(eqx.Module):
    """Albedo of the visible part of a face in UV space; row 0 of the maps at the top."""

    albedo: Float[Array, "r r 3"]
    """linear RGB, never negative, not limited above; 0 where ``weight`` is 0"""
    weight: Float[Array, "r r"]
    """smooth confidence in [0, 1]; continued into the gutter around the charts"""
    visible: Bool[Array, "r r"]
    """True where the photo shows the texel: inside a chart, facing the camera, unoccluded, within
    the mask and the photo, at any angle"""


@partial(
    jax.jit,
    static_argnames=("grazing", "feather_width", "shading_floor", "depth_size", "tile"),
)
def unwrap(
    photo: Float[Array, "h w 3"],
    mask: Shaped[Array, "h w"],
    vertices: Float[Array, "n 3"],
    faces: Int[Array, "f 3"],
    camera: Camera,
    light: Float[Array, "9 3"],
    layout: UVLayout,
    *,
    grazing: tuple[float, float] = (75.0, 50.0),
    feather_width: float = 3.0,
    shading_floor: float = 0.1,
    depth_size: int = 1024,
    tile: int = 128,
) -> PartialAlbedo:
    """Albedo ``photo / (H(n) L)`` of every texel the photo shows, and how far to trust it.

    The weight is the product of four smooth factors: the angle to the view; the mask, feathered
    inwards together with the border of the photo and the contours where one part of the
    face hides another (pixels there mix two surfaces); the shading, where it is too dark to
    divide by; and visibility. Colours are averaged with the feathered mask as their weight
    (normalised convolution, Knutsson and Westin 1993), so nothing outside it bleeds in. Where
    the photo is denser than the texture, a mipmap level with pixels as large as the texels
    (in area) is read.

    Differentiable in photo, light and vertices, in forward and reverse mode, for fixed visibility.
    Memory beyond the results is that of one tile.

    Args:
        photo: linear-light RGB. Crop a large photo to the face first.
        mask: pixels that show the face, bool or soft in [0, 1].
        vertices: posed, in the camera's frame, mm.
        faces: triangles, counter-clockwise seen from outside.
        camera: the photo's projection.
        light: shading coefficients in the camera's frame (see ``render.shading``).
        layout: from ``geometry.uv.uv_layout`` for the same triangles.
        grazing: angles between normal and view (degrees) where the weight reaches 0 and 1.
        feather_width: width of the soft edge inside the mask, px of the photo.
        shading_floor: smallest shading divided by, as a part of the mean over the vertices that
            face the camera. The weight is 0 where a channel is below it, 1 from twice that.
        depth_size: the longer side of the depth buffer, px, at most that of the photo.
        tile: texels along a side of the blocks worked on at once.

    Raises:
        ValueError: shapes of photo, mask, faces and layout do not fit together, or an option is
            out of range.
    """
    _check(photo, mask, faces, layout, grazing, shading_floor)
    height, width = photo.shape[:2]
    scale = min(1.0, depth_size / max(height, width))
    depth, reliable = _visibility(vertices, faces, camera, height, width, scale, feather_width)
    padded = jnp.pad(mask > 0, 1)
    alpha = feather(padded, feather_width)[1:-1, 1:-1] * mask * reliable
    pyramid = mipmap(jnp.concatenate([photo * alpha[..., None], alpha[..., None]], axis=-1))

    normals = vertex_normals(vertices, faces)
    table, alive, shade = _triangles(vertices, normals, faces, camera, light, layout, photo)
    floor = jax.lax.stop_gradient(shading_floor * shade)
    cos_zero, cos_one = (math.cos(math.radians(angle)) for angle in grazing)

    def colour(triangle: Array, barycentric: Array) -> tuple[Array, Array]:
        row = table[triangle]
        b, c = barycentric[:, :1], barycentric[:, 1:]
        point = row[:, 0:3] + row[:, 3:6] * b + row[:, 6:9] * c
        normal = safe_normalize(row[:, 9:12] + row[:, 12:15] * b + row[:, 15:18] * c)
        screen = camera.project(point)
        seen = _unoccluded(point, screen, row[:, 18:21], depth, camera, scale)
        cosine = -jnp.sum(normal * safe_normalize(point), axis=-1)
        sample = pyramid.trilinear(screen[:, :2], jax.lax.stop_gradient(row[:, 21]))
        shading = irradiance(normal, light)
        lit = smoothstep(jnp.min(shading, axis=-1), floor, 2 * floor)
        cover = sample[:, 3]
        weight = smoothstep(cosine, cos_zero, cos_one) * cover * lit * seen
        linear = sample[:, :3] / jnp.maximum(cover, 1e-4)[:, None]
        albedo = jnp.maximum(linear, 0.0) / jnp.maximum(shading, floor)
        albedo = jnp.where(weight[:, None] > 0, albedo, 0.0)
        return jnp.concatenate([albedo, weight[:, None]], axis=-1), seen & (cover > 0)

    values, seen = _by_tiles(colour, layout, alive, min(tile, layout.resolution), photo.dtype)
    return PartialAlbedo(values[..., :3], values[..., 3], seen & layout.inside)


def _visibility(
    vertices: Array,
    faces: Array,
    camera: Camera,
    height: int,
    width: int,
    scale: float,
    feather_width: float,
) -> tuple[Array, Array]:
    """Depth buffer (mm), and how far each pixel of the photo is from a depth jump (0 to 1)."""
    shape = max(1, math.ceil(height * scale)), max(1, math.ceil(width * scale))
    screen = jax.lax.stop_gradient(camera.scaled(scale).project(vertices))
    depth = jax.lax.stop_gradient(rasterize(screen, faces, *shape).depth)
    jump = jnp.zeros(shape, bool)
    for axis in (0, 1):
        near, far = (jnp.take(depth, jnp.arange(s, e), axis) for s, e in _pairs(shape[axis]))
        step = jnp.abs(near - far) * camera.focal * scale
        steep = step > _STEEPEST * jnp.minimum(near, far)
        before, after = [(0, 0), (0, 0)], [(0, 0), (0, 0)]
        before[axis], after[axis] = (0, 1), (1, 0)
        jump = jump | jnp.pad(steep, before) | jnp.pad(steep, after)
    reliable = feather(~jump, max(1.0, feather_width * scale))
    if shape != (height, width):
        x, y = ((jnp.arange(n) + 0.5) * scale for n in (width, height))
        points = jnp.stack(jnp.meshgrid(x, y), axis=-1).reshape(-1, 2)
        reliable = mipmap(reliable[..., None], 1).bilinear(points).reshape(height, width)
    return depth, reliable


def _pairs(size: int) -> tuple[tuple[int, int], tuple[int, int]]:
    return (0, size - 1), (1, size)


def _triangles(
    vertices: Array,
    normals: Array,
    faces: Array,
    camera: Camera,
    light: Array,
    layout: UVLayout,
    photo: Array,
) -> tuple[Array, Array, Array]:
    """What a texel needs of its triangle, which triangles may be seen, and the mean shading.

    A row holds a corner and two edges of the positions (9), of the normals (9), the face
    normal (3) and the mipmap level (1): one gather a texel instead of seven.
    """
    corner = vertices[faces]
    screen = camera.project(corner.reshape(-1, 3)).reshape(-1, 3, 3)
    flat = face_areas_normals(vertices, faces)
    facing = jnp.sum(flat * corner[:, 0], axis=-1) < 0
    # Smooth shading needs smooth normals, so a triangle in profile may have corners facing away.
    size = jnp.array([photo.shape[1], photo.shape[0]], screen.dtype)
    off = jnp.all(screen[..., :2] < 0, axis=1) | jnp.all(screen[..., :2] > size, axis=1)
    alive = facing & ~jnp.any(off, axis=-1) & jnp.all(screen[..., 2] > 0, axis=-1)
    b, c = screen[:, 1, :2] - screen[:, 0, :2], screen[:, 2, :2] - screen[:, 0, :2]
    pixels = 0.5 * jnp.abs(b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
    ratio = jnp.maximum(pixels, 1e-12) / jnp.maximum(layout.area, 1e-12)
    level = jax.lax.stop_gradient(0.5 * jnp.log2(ratio))
    parts = []
    for values in (corner, normals[faces]):
        parts += [values[:, 0], values[:, 1] - values[:, 0], values[:, 2] - values[:, 0]]
    table = jnp.concatenate([*parts, safe_normalize(flat), level[:, None]], axis=-1)
    front = jnp.sum(normals * vertices, axis=-1, keepdims=True) < 0
    shading = jnp.where(front, irradiance(normals, light), 0.0)
    mean = jnp.sum(shading) / jnp.maximum(3 * jnp.sum(front), 1)
    return table, alive, jnp.maximum(mean, 1e-6)


def _unoccluded(
    point: Array, screen: Array, face_normal: Array, depth: Array, camera: Camera, scale: float
) -> Array:
    """Whether nothing in the depth buffer lies in front of the surface points.

    The triangle's plane is extended to the centre of the buffer's pixel, so its slope cannot
    be mistaken for an occluder; what is left, the curvature within a pixel, is within the tolerance of
    one pixel's size on the surface.
    """
    height, width = depth.shape
    x, y = screen[:, 0] * scale, screen[:, 1] * scale
    column = jnp.clip(jnp.floor(x), 0, width - 1)
    row = jnp.clip(jnp.floor(y), 0, height - 1)
    focal = camera.focal * scale
    ray = jnp.stack(
        [
            (column + 0.5 - camera.principal[0] * scale) / focal,
            -(row + 0.5 - camera.principal[1] * scale) / focal,
            -jnp.ones_like(column),
        ],
        axis=-1,
    )
    slope = jnp.minimum(jnp.sum(face_normal * ray, axis=-1), -1e-3)
    plane = jnp.sum(face_normal * point, axis=-1) / slope
    pixel = screen[:, 2] / focal
    tangent = jnp.minimum(-1.0 / slope, _STEEPEST)
    # At a glancing angle the plane may run away within a pixel; the point itself bounds it.
    expected = jnp.clip(plane, screen[:, 2] - _STEEPEST * pixel, screen[:, 2] + _STEEPEST * pixel)
    index = row.astype(jnp.int32) * width + column.astype(jnp.int32)
    nearest = depth.reshape(-1).at[index].get(mode="promise_in_bounds")
    inside = (x >= 0) & (x <= width) & (y >= 0) & (y <= height)
    return jax.lax.stop_gradient(inside & (nearest > expected - 0.5 * pixel * (1.0 + tangent)))


def _by_tiles(colour, layout: UVLayout, alive: Array, tile: int, dtype) -> tuple[Array, Array]:
    """Evaluate ``colour`` on square tiles of the texture, skipping those with nothing to see."""
    size = layout.resolution
    count = -(-size // tile)
    extra = count * tile - size
    triangle = jnp.pad(layout.triangle, ((0, extra), (0, extra)), constant_values=-1)
    barycentric = jnp.pad(layout.barycentric, ((0, extra), (0, extra), (0, 0)))

    @jax.checkpoint
    def one(index: Array) -> tuple[Array, Array]:
        row, column = (index // count) * tile, (index % count) * tile
        ids = jax.lax.dynamic_slice(triangle, (row, column), (tile, tile)).reshape(-1)
        weights = jax.lax.dynamic_slice(barycentric, (row, column, 0), (tile, tile, 2))
        live = (ids >= 0) & alive[jnp.maximum(ids, 0)]

        def evaluate() -> tuple[Array, Array]:
            values, seen = colour(jnp.maximum(ids, 0), weights.reshape(-1, 2).astype(dtype))
            return jnp.where(live[:, None], values, 0.0), seen & live

        def skip() -> tuple[Array, Array]:
            return jnp.zeros((tile * tile, 4), dtype), jnp.zeros(tile * tile, bool)

        return jax.lax.cond(jnp.any(live), evaluate, skip)

    values, seen = jax.lax.map(one, jnp.arange(count * count))

    def assemble(tiles: Array) -> Array:
        grid = tiles.reshape(count, count, tile, tile, -1)
        return jnp.swapaxes(grid, 1, 2).reshape(count * tile, count * tile, -1)[:size, :size]

    return assemble(values), assemble(seen)[..., 0]


def _check(
    photo: Array,
    mask: Array,
    faces: Array,
    layout: UVLayout,
    grazing: tuple[float, float],
    shading_floor: float,
) -> None:
    if photo.ndim != 3 or photo.shape[2] != 3:
        raise ValueError(f"photo has shape {photo.shape}; it needs (h, w, 3) linear RGB")
    if mask.shape != photo.shape[:2]:
        raise ValueError(f"mask has shape {mask.shape}; the photo's is {photo.shape[:2]}")
    if layout.area.shape[0] != faces.shape[0]:
        raise ValueError(
            f"layout is of {layout.area.shape[0]} triangles, but faces has {faces.shape[0]}; "
            "both must come from the same topology"
        )
    if not 90.0 >= grazing[0] > grazing[1] >= 0.0:
        raise ValueError(f"grazing is {grazing}; it needs 90 >= zero-weight > full-weight >= 0")
    if shading_floor <= 0:
        raise ValueError(f"shading_floor is {shading_floor}; it needs a positive part of the mean")
