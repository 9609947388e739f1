"""The partial high-frequency albedo (Saito 2017, section 3): the photo, unlit, in UV space.

Every texel is taken to its point on the fitted surface, the point to the photo, and the colour
found there is divided by the shading of the fitted light at the point's normal. What the photo
does not show well fades out by a smooth weight.
"""

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
from jaxface.imaging.mipmap import mipmap
from jaxface.render._depth_buffer import depth_buffer
from jaxface.render.shading import irradiance, sh_basis


class PartialAlbedo(eqx.Module):
    """Albedo of the visible part of a face in UV space; row 0 of the maps at the top."""

    albedo: Float[Array, "r r 3"]
    """linear RGB, never negative, not limited above; 0 where ``weight`` is 0"""
    weight: Float[Array, "r r"]
    """smooth confidence in [0, 1]; continued into the gutter around the charts"""
    visible: Bool[Array, "r r"]
    """True where the photo shows the texel, at any angle: inside a chart, facing the camera, not
    hidden, within the photo and (to a texel's footprint) the mask, off the contours' pixels"""


def unwrap(
    photo: Float[Array, "h w 3"],
    mask: Shaped[Array, "h w"],
    vertices: Float[Array, "n 3"],
    faces: Int[Array, "f 3"],
    camera: Camera,
    light: Float[Array, "9 3"],
    layout: UVLayout,
    hidden: Float[Array, "n 3"] | None = None,
    *,
    grazing: tuple[float, float] = (75.0, 50.0),
    feather_width: float = 3.0,
    shading_floor: float = 0.1,
    depth_size: int = 512,
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
        hidden: shading (negative) that the face takes from itself at each vertex, added to
            ``H(n) L``; see ``render.occlusion``.
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
    cosines = jnp.cos(jnp.deg2rad(jnp.asarray(grazing, photo.dtype)))
    return _unwrap(
        photo, mask, vertices, faces, camera, light, layout, hidden, cosines, shading_floor,
        feather_width=feather_width, depth_size=depth_size, tile=min(tile, layout.resolution),
    )  # fmt: skip


@partial(jax.jit, static_argnames=("feather_width", "depth_size", "tile"))
def _unwrap(
    photo: Array,
    mask: Array,
    vertices: Array,
    faces: Array,
    camera: Camera,
    light: Array,
    layout: UVLayout,
    hidden: Array | None,
    cosines: Array,
    shading_floor: Array,
    *,
    feather_width: float,
    depth_size: int,
    tile: int,
) -> PartialAlbedo:
    height, width = photo.shape[:2]
    buffer = depth_buffer(vertices, faces, camera, height, width, depth_size)
    inside = feather(jnp.pad(mask > 0, 1), feather_width)[1:-1, 1:-1] * mask
    alpha = (inside * buffer.clear_of_contours(height, width, feather_width)).astype(photo.dtype)
    pyramid = mipmap(jnp.concatenate([photo * alpha[..., None], alpha[..., None]], axis=-1))

    normals = vertex_normals(vertices, faces)
    front = jnp.sum(normals * vertices, axis=-1, keepdims=True) < 0
    lit = jnp.sum(jnp.where(front, irradiance(normals, light), 0.0)) / jnp.maximum(
        3 * jnp.sum(front), 1
    )
    floor = jax.lax.stop_gradient(jnp.maximum(shading_floor * lit, 1e-6))
    table, alive = _triangles(vertices, normals, faces, camera, layout, (width, height), hidden)

    # Every quantity of a tile is one vector of texels per component: loops over a short last
    # axis are several times slower on a CPU, and the stacks below cost nothing once compiled.
    def texels(triangle: Array, b: Array, c: Array) -> tuple[Array, Array, Array]:
        def column(k: int) -> Array:
            return table.at[triangle, k].get(mode="promise_in_bounds")

        def across(k: int) -> Array:
            corner, first, second = (
                jnp.stack([column(k + i) for i in (0, 1, 2)], axis=-1) for k in (k, k + 3, k + 6)
            )
            return corner + first * b[:, None] + second * c[:, None]

        point, normal = across(0), across(9)
        normal = normal * jax.lax.rsqrt(jnp.maximum(_dot(normal, normal), 1e-12))[:, None]
        screen = camera.project(point)
        face_normal = jnp.stack([column(18), column(19), column(20)], axis=-1)
        seen = buffer.unoccluded(point, face_normal)
        cosine = -_dot(normal, point) * jax.lax.rsqrt(jnp.maximum(_dot(point, point), 1e-12))
        sample = pyramid.trilinear(screen[:, :2], jax.lax.stop_gradient(column(21)))
        cover = sample[:, 3]
        basis = sh_basis(normal)
        shading = [sum(basis[:, k] * light[k, rgb] for k in range(9)) for rgb in range(3)]
        if hidden is not None:
            taken = across(22)
            shading = [shading[rgb] + taken[:, rgb] for rgb in range(3)]
        darkest = jnp.minimum(jnp.minimum(shading[0], shading[1]), shading[2])
        weight = smoothstep(cosine, cosines[0], cosines[1]) * cover * seen
        weight = weight * smoothstep(darkest, floor, 2 * floor)
        inverse = 1.0 / jnp.maximum(cover, 1e-4)
        albedo = [
            jnp.maximum(sample[:, rgb] * inverse, 0.0) / jnp.maximum(shading[rgb], floor)
            for rgb in range(3)
        ]
        return jnp.stack(albedo, axis=-1), weight, seen & (cover > 0)

    return _by_tiles(texels, layout, alive, tile, photo.dtype)


def _dot(a: Array, b: Array) -> Array:
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def _triangles(
    vertices: Array,
    normals: Array,
    faces: Array,
    camera: Camera,
    layout: UVLayout,
    size: tuple[int, int],
    hidden: Array | None,
) -> tuple[Array, Array]:
    """What a texel needs of its triangle, and which triangles the photo may show at all.

    A row holds a corner and two edges of the positions (9), the same of the normals (9), the
    face normal (3), the mipmap level (1) and, if there is one, corner and edges of the hidden
    shading (9): one look-up a texel instead of seven.
    """
    corner = vertices[faces]
    screen = camera.project(corner)
    flat = face_areas_normals(vertices, faces)
    facing = jnp.sum(flat * corner[:, 0], axis=-1) < 0
    beyond = jnp.all(screen[..., :2] < 0, axis=1)
    beyond = beyond | jnp.all(screen[..., :2] > jnp.array(size, screen.dtype), axis=1)
    alive = facing & ~jnp.any(beyond, axis=-1) & jnp.all(screen[..., 2] > 0, axis=-1)
    b, c = screen[:, 1, :2] - screen[:, 0, :2], screen[:, 2, :2] - screen[:, 0, :2]
    pixels = 0.5 * jnp.abs(b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
    level = 0.5 * jnp.log2(jnp.maximum(pixels, 1e-12) / jnp.maximum(layout.area, 1e-12))

    def edges(values: Array) -> list[Array]:
        return [values[:, 0], values[:, 1] - values[:, 0], values[:, 2] - values[:, 0]]

    parts = [*edges(corner), *edges(normals[faces]), safe_normalize(flat), level[:, None]]
    if hidden is not None:
        parts += edges(hidden[faces])
    return jnp.concatenate(parts, axis=-1), alive


def _by_tiles(texels, layout: UVLayout, alive: Array, tile: int, dtype) -> PartialAlbedo:
    """Evaluate ``texels`` on square tiles of the texture, skipping those with nothing to see."""
    size = layout.resolution
    count = -(-size // tile)
    extra = count * tile - size
    triangle = jnp.pad(layout.triangle, ((0, extra), (0, extra)), constant_values=-1)
    barycentric = jnp.pad(layout.barycentric, ((0, extra), (0, extra), (0, 0)))
    inside = jnp.pad(layout.inside, ((0, extra), (0, extra)))

    def one(row: Array, column: Array) -> tuple[Array, Array, Array]:
        at, square = (row * tile, column * tile), (tile, tile)
        ids = jax.lax.dynamic_slice(triangle, at, square).reshape(-1)
        weights = jax.lax.dynamic_slice(barycentric, (*at, 0), (*square, 2)).reshape(-1, 2)
        chart = jax.lax.dynamic_slice(inside, at, square).reshape(-1)
        live = (ids >= 0) & alive[jnp.maximum(ids, 0)]

        def evaluate() -> tuple[Array, Array, Array]:
            b, c = weights[:, 0].astype(dtype), weights[:, 1].astype(dtype)
            albedo, weight, seen = texels(jnp.maximum(ids, 0), b, c)
            weight = jnp.where(live, weight, 0.0).astype(dtype)
            albedo = jnp.where(weight[:, None] > 0, albedo, 0.0).astype(dtype)
            return albedo, weight, seen & live & chart

        def skip() -> tuple[Array, Array, Array]:
            n = tile * tile
            return jnp.zeros((n, 3), dtype), jnp.zeros(n, dtype), jnp.zeros(n, bool)

        return jax.lax.cond(jnp.any(live), evaluate, skip)

    # Rows of tiles stack up to the texture as they are; only within one are texels reordered.
    @jax.checkpoint
    def strip(row: Array) -> tuple[Array, ...]:
        tiles = jax.lax.map(lambda column: one(row, column), jnp.arange(count))
        squares = (x.reshape(count, tile, tile, *x.shape[2:]) for x in tiles)
        return tuple(
            jnp.swapaxes(x, 0, 1).reshape(tile, count * tile, *x.shape[3:]) for x in squares
        )

    maps = jax.lax.map(strip, jnp.arange(count))
    return PartialAlbedo(
        *(x.reshape(count * tile, count * tile, *x.shape[3:])[:size, :size] for x in maps)
    )


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
