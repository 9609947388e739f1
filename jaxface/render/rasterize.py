"""Z-buffered rasterisation of triangle meshes, in pure JAX.

Which triangle a pixel sees is a discrete question: ``rasterize`` answers it without a
derivative. Where on that triangle the pixel falls is a smooth one: ``barycentrics`` answers it
for fixed triangle ids, differentiably in the vertices (both modes), and ``rasterize`` takes its
own weights from there. So gradients are those of a picture whose visibility is fixed; they are
exact inside a silhouette and know nothing of a silhouette's motion.

Coverage. A pixel belongs to a triangle when its centre lies inside, or on a *top* or *left*
edge (the usual fill rule), so that of two triangles sharing an edge exactly one takes a centre on
it: no cracks, no double cover. Each edge function is computed relative to the pixel and with
its two corners in a canonical order, so both triangles of an edge see bitwise opposite values and
rounding cannot open a crack either. Equal depths go to the lowest triangle index.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxface._numerics import safe_divide
from jaxface._types import Array, Bool, Float, Int

_BATCH_FRAGMENTS = 1 << 16
_BATCH_TRIANGLES = 1 << 13


class Fragments(eqx.Module):
    """What each pixel of an image sees of a mesh."""

    triangle: Int[Array, "h w"]
    """index of the nearest triangle, -1 on the background"""
    barycentric: Float[Array, "h w 3"]
    """perspective-correct weights of the triangle's corners, 0 on the background"""
    depth: Float[Array, "h w"]
    """distance along the viewing axis (mm), inf on the background"""

    @property
    def mask(self) -> Bool[Array, "h w"]:
        """True where a triangle is seen."""
        return self.triangle >= 0


def _edge(ax: Array, ay: Array, bx: Array, by: Array) -> Array:
    """Cross product ``a x b`` of corners relative to a pixel, bitwise antisymmetric in a and b.

    A compiler may contract one of the two products into a fused multiply-add, which breaks the
    antisymmetry of the plain formula; evaluating in a fixed order of the corners restores it.
    """
    swap = (ax > bx) | ((ax == bx) & (ay > by))
    px, py = jnp.where(swap, bx, ax), jnp.where(swap, by, ay)
    qx, qy = jnp.where(swap, ax, bx), jnp.where(swap, ay, by)
    value = px * qy - py * qx
    return jnp.where(swap, -value, value)


def _inside(corners: list[tuple[Array, Array]]) -> tuple[Array, list[Array]]:
    """Whether the origin is in triangles, and the edge functions opposite to each corner.

    With y down, a positive triangle (all edge functions positive) runs clockwise on the
    screen: its left edges go up (dy < 0), its top edges go right (dy = 0, dx > 0).
    """
    weights, positive, negative = [], True, True
    for i in range(3):
        (ax, ay), (bx, by) = corners[(i + 1) % 3], corners[(i + 2) % 3]
        e = _edge(ax, ay, bx, by)
        on_edge = e == 0
        top_left = (by < ay) | ((by == ay) & (bx > ax))
        bottom_right = (by > ay) | ((by == ay) & (bx < ax))
        positive = positive & ((e > 0) | (on_edge & top_left))
        negative = negative & ((e < 0) | (on_edge & bottom_right))
        weights.append(e)
    return positive | negative, weights


def _blocks(
    screen: Float[Array, "n 3"], faces: Int[Array, "f 3"], height: int, width: int, near: float
) -> tuple[Array, Array, Array, Array]:
    """First column and row, columns, rows of the pixel centres in each triangle's bounding box."""
    corners = screen[faces]
    drawable = jnp.all(jnp.isfinite(corners), axis=(1, 2)) & jnp.all(corners[..., 2] > near, axis=1)
    low, high = jnp.min(corners[..., :2], axis=1), jnp.max(corners[..., :2], axis=1)
    size = jnp.array([width, height], screen.dtype)
    first = jnp.clip(jnp.ceil(low - 0.5), 0, size)
    last = jnp.clip(jnp.floor(high - 0.5), -1, size - 1)
    count = jnp.maximum(last - first + 1, 0)
    count = jnp.where(drawable[:, None], count, 0)
    first, count = first.astype(jnp.int32), count.astype(jnp.int32)
    return first[:, 0], first[:, 1], count[:, 0], count[:, 1]


@partial(jax.jit, static_argnames=("height", "width", "cull"))
def _visible(
    screen: Float[Array, "n 3"],
    faces: Int[Array, "f 3"],
    near: Float[Array, ""],
    height: int,
    width: int,
    cull: bool,
) -> Int[Array, "h w"]:
    """Index of the nearest triangle at each pixel."""
    total = faces.shape[0]
    x0, y0, columns, rows = _blocks(screen, faces, height, width, near)
    area = columns * rows
    pixels = height * width
    slots = jnp.arange(_BATCH_FRAGMENTS, dtype=jnp.int32)

    def more(state):
        return state[0] < total

    def batch(state):
        cursor, skip, nearest, index = state
        ids = cursor + jnp.arange(_BATCH_TRIANGLES, dtype=jnp.int32)
        here = ids < total
        clipped = jnp.minimum(ids, total - 1)
        n = jnp.where(here, area[clipped], 0).at[0].add(-skip)
        n = jnp.minimum(n, _BATCH_FRAGMENTS + 1)
        ends = jnp.cumsum(n)
        starts = ends - n
        owner = jnp.searchsorted(ends, slots, side="right").astype(jnp.int32)
        live = owner < _BATCH_TRIANGLES
        owner = jnp.minimum(owner, _BATCH_TRIANGLES - 1)
        t = jnp.minimum(cursor + owner, total - 1)
        offset = slots - starts[owner] + jnp.where(owner == 0, skip, 0)
        wide = jnp.maximum(columns[t], 1)
        px, py = x0[t] + offset % wide, y0[t] + offset // wide
        corner = screen[faces[t]]
        centre_x, centre_y = px.astype(screen.dtype) + 0.5, py.astype(screen.dtype) + 0.5
        relative = [(corner[:, i, 0] - centre_x, corner[:, i, 1] - centre_y) for i in range(3)]
        inside, e = _inside(relative)
        if cull:
            inside = inside & (e[0] + e[1] + e[2] < 0)
        twice_area = e[0] + e[1] + e[2]
        inverse = sum(e[i] / corner[:, i, 2] for i in range(3))
        depth = twice_area / inverse
        inside = inside & live & jnp.isfinite(depth)
        where = jnp.where(inside, py * width + px, pixels)
        closer = nearest.at[where].min(depth, mode="drop")
        index = jnp.where(closer < nearest, total, index)
        seen = inside & (depth == closer[jnp.minimum(where, pixels - 1)])
        index = index.at[jnp.where(seen, where, pixels)].min(t, mode="drop")
        # The next batch starts at the first triangle with fragments left.
        done = jnp.sum(ends <= _BATCH_FRAGMENTS, dtype=jnp.int32)
        stopped = jnp.minimum(done, _BATCH_TRIANGLES - 1)
        used = jnp.where(done < _BATCH_TRIANGLES, _BATCH_FRAGMENTS - starts[stopped], 0)
        skip = used + jnp.where(done == 0, skip, 0)
        return cursor + done, skip, closer, index

    start = (
        jnp.int32(0),
        jnp.int32(0),
        jnp.full((pixels,), jnp.inf, screen.dtype),
        jnp.full((pixels,), total, jnp.int32),
    )
    *_, index = jax.lax.while_loop(more, batch, start)
    return jnp.where(index == total, -1, index).reshape(height, width)


def barycentrics(
    screen: Float[Array, "n 3"], faces: Int[Array, "f 3"], triangle: Int[Array, "h w"]
) -> Float[Array, "h w 3"]:
    """Perspective-correct weights of given triangles at the pixel centres.

    ``b_i = (e_i / z_i) / sum_j (e_j / z_j)`` with ``e_i`` the edge function opposite to corner i
    (Blinn, "Hyperbolic interpolation", IEEE CG&A 1992). Differentiable in ``screen`` in forward
    and reverse mode for the ids given; the weights of a triangle that does not cover its pixel
    extrapolate.

    Args:
        screen: vertices as ``Camera.project`` gives them (x px, y px down, depth mm).
        faces: corners of the triangles.
        triangle: the triangle at each pixel, -1 for none.

    Returns:
        Weights that sum to one; zero where there is no triangle or its area on the screen is zero.
    """
    height, width = triangle.shape
    corner = screen[faces[jnp.maximum(triangle, 0)]]
    centre_x = jnp.arange(width, dtype=screen.dtype) + 0.5
    centre_y = (jnp.arange(height, dtype=screen.dtype) + 0.5)[:, None]
    x, y = corner[..., 0] - centre_x[:, None], corner[..., 1] - centre_y[..., None]
    e = jnp.stack(
        [
            x[..., (i + 1) % 3] * y[..., (i + 2) % 3] - y[..., (i + 1) % 3] * x[..., (i + 2) % 3]
            for i in range(3)
        ],
        axis=-1,
    )
    weight = safe_divide(e, corner[..., 2])
    total = jnp.sum(weight, axis=-1, keepdims=True)
    return safe_divide(weight, jnp.where(triangle[..., None] >= 0, total, 0.0))


def rasterize(
    screen: Float[Array, "n 3"],
    faces: Int[Array, "f 3"],
    height: int,
    width: int,
    *,
    cull: bool = False,
    near: float = 0.0,
) -> Fragments:
    """Nearest triangle, its barycentric weights and its depth at every pixel centre.

    The module's docstring states the coverage rule. A triangle is drawn only if all its corners
    are finite and deeper than ``near``: one that straddles the camera plane is dropped whole,
    not clipped. ``triangle`` carries no derivative, ``barycentric`` and ``depth`` do.

    Args:
        screen: vertices as ``Camera.project`` gives them (x px, y px down, depth mm).
        faces: corners of the triangles, counter-clockwise seen from outside.
        height: rows of the image.
        width: columns of the image.
        cull: drop triangles seen from behind.
        near: smallest depth (mm) drawn, exclusive.

    Raises:
        ValueError: the image is empty, or an argument does not have the shape stated.
    """
    if height < 1 or width < 1:
        raise ValueError(f"height and width are {height} and {width}; both must be positive")
    if screen.ndim != 2 or screen.shape[1] != 3:
        raise ValueError(f"screen has shape {screen.shape}; (n, 3) is needed")
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError(f"faces has shape {faces.shape}; (f, 3) is needed")
    if faces.shape[0] == 0 or screen.shape[0] == 0:
        triangle = jnp.full((height, width), -1, jnp.int32)
        return Fragments(
            triangle,
            jnp.zeros((height, width, 3), screen.dtype),
            jnp.full((height, width), jnp.inf, screen.dtype),
        )
    fixed = jax.lax.stop_gradient(screen)
    triangle = _visible(fixed, faces, jnp.asarray(near, screen.dtype), height, width, cull)
    weights = barycentrics(screen, faces, triangle)
    deep = screen[faces[jnp.maximum(triangle, 0)], 2]
    depth = jnp.where(triangle >= 0, jnp.sum(weights * deep, axis=-1), jnp.inf)
    return Fragments(triangle, weights, depth)
