"""Rasterisation of triangle meshes: what every pixel sees, in pure JAX.

Which triangle a pixel sees is a discrete question: ``zbuffer`` answers it without a
derivative. Where on that triangle the pixel falls is a smooth one: ``barycentrics`` answers it
for fixed triangle ids, differentiably in the vertices (both modes), and ``rasterize`` takes its
weights from there. So gradients are those of a picture whose visibility is fixed; they are
exact inside a silhouette and know nothing of a silhouette's motion.
"""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxface._numerics import safe_divide
from jaxface._types import Array, Bool, Float, Int
from jaxface.render.zbuffer import nearest_triangles


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
    centre_x = jnp.arange(width, dtype=screen.dtype) + 0.5
    centre_y = (jnp.arange(height, dtype=screen.dtype) + 0.5)[:, None]
    # A gather of whole rows for each corner: three times faster than one gather of all corners.
    corners = [screen[faces[:, i][jnp.maximum(triangle, 0)]] for i in range(3)]
    x, y = [c[..., 0] - centre_x for c in corners], [c[..., 1] - centre_y for c in corners]
    weights = [
        safe_divide(x[j] * y[k] - y[j] * x[k], corners[i][..., 2])
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1))
    ]
    total = jnp.where(triangle >= 0, weights[0] + weights[1] + weights[2], 0.0)
    inverse = safe_divide(jnp.ones_like(total), total)
    return jnp.stack([weight * inverse for weight in weights], axis=-1)


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

    A centre on an edge belongs to the triangle for which the edge is a top or left one (see
    ``coverage``); equal depths go to the lowest triangle index. A triangle is drawn only if all
    its corners are finite and deeper than ``near``: one that straddles the camera plane is
    dropped whole, not clipped. ``triangle`` has no derivative, ``barycentric`` and ``depth`` do.

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
    nearest = _nearest(height, width, cull, float(near))
    triangle = nearest(jax.lax.stop_gradient(screen), faces)
    weights = barycentrics(screen, faces, triangle)
    seen = jnp.maximum(triangle, 0)
    depth = sum(weights[..., i] * screen[faces[:, i][seen], 2] for i in range(3))
    depth = jnp.where(triangle >= 0, depth, jnp.inf)
    return Fragments(triangle, weights, depth)


@cache
def _nearest(height: int, width: int, cull: bool, near: float):
    """``nearest_triangles`` of one scene, under ``vmap`` of all the batch's scenes as one.

    JAX would batch the loop inside by copying the image of every finished scene each time around.
    """

    @jax.custom_batching.custom_vmap
    def nearest(screen: Array, faces: Array) -> Array:
        flat = screen.reshape(-1, *screen.shape[-2:])
        if flat.shape[0] * height * width > jnp.iinfo(jnp.int32).max:
            raise ValueError(
                f"a batch of {flat.shape[0]} images of {height} x {width} has more pixels than "
                f"an int32 counts; use a smaller batch"
            )
        indices = jnp.broadcast_to(faces, (*screen.shape[:-2], *faces.shape[-2:]))
        indices = indices.reshape(-1, *faces.shape[-2:]).astype(jnp.int32)
        triangle = nearest_triangles(flat, indices, height, width, cull, near)
        return triangle.reshape(*screen.shape[:-2], height, width)

    @nearest.def_vmap
    def _(axis_size, batched, screen, faces):
        if not batched[0]:
            screen = jnp.broadcast_to(screen, (axis_size, *screen.shape))
        if batched[1] and faces.ndim < screen.ndim:
            faces = jnp.expand_dims(faces, tuple(range(1, screen.ndim - faces.ndim + 1)))
        return nearest(screen, faces), True

    return nearest
