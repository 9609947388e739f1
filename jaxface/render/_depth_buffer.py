"""Which points of a surface a photo shows: a depth buffer, its contours, the test against it."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxface._types import Array, Bool, Float, Int
from jaxface.geometry.camera import Camera
from jaxface.imaging.masks import feather
from jaxface.imaging.mipmap import mipmap
from jaxface.render._rasterize import rasterize

# A surface seen steeper than this (tangent of the angle to the view) counts as a depth jump.
_STEEPEST = 6.0


class DepthBuffer(eqx.Module):
    """Depth of the nearest surface at each pixel of a photo, perhaps at a lower resolution."""

    depth: Float[Array, "h w"]
    """mm along the viewing axis, inf on the background"""
    camera: Camera
    """projection to the buffer's own pixels"""
    scale: float = eqx.field(static=True)
    """pixels of the buffer per pixel of the photo"""

    def contours(self) -> Bool[Array, "h w"]:
        """Pixels on either side of a depth jump, where one part of the surface hides another.

        A jump is a difference to a neighbour beyond that of a surface seen at 80 degrees.
        """
        height, width = self.depth.shape
        jump = jnp.zeros((height, width), bool)
        vertical = self._jumps(self.depth[:-1], self.depth[1:])
        jump = jump.at[:-1].set(vertical).at[1:].max(vertical)
        horizontal = self._jumps(self.depth[:, :-1], self.depth[:, 1:])
        return jump.at[:, :-1].max(horizontal).at[:, 1:].max(horizontal)

    def _jumps(self, first: Array, second: Array) -> Array:
        nearer = jnp.minimum(first, second)
        return jnp.abs(first - second) * self.camera.focal > _STEEPEST * nearer

    def clear_of_contours(
        self, height: int, width: int, feather_width: float
    ) -> Float[Array, "height width"]:
        """How surely each pixel of the photo shows one surface alone.

        0 at contours, 1 from ``feather_width`` px of the photo (at least one of the buffer) away.
        """
        clear = feather(~self.contours(), max(1.0, feather_width * self.scale))
        if clear.shape == (height, width):
            return clear
        x, y = ((jnp.arange(n) + 0.5) * self.scale for n in (width, height))
        points = jnp.stack(jnp.meshgrid(x, y), axis=-1).reshape(-1, 2)
        return mipmap(clear[..., None], 1).bilinear(points).reshape(height, width)

    def unoccluded(
        self, points: Float[Array, "n 3"], face_normals: Float[Array, "n 3"]
    ) -> Bool[Array, "n"]:
        """Whether surface points lie within the photo and nothing in the buffer hides them.

        The plane of a point's triangle is extended to the centre of the pixel, so a slope cannot
        be mistaken for an occluder; what is left is curvature within a pixel, and the tolerance
        for it grows with the pixel's size on the surface. No derivative.

        Args:
            points: in the camera's frame, mm.
            face_normals: unit normals of the triangles they lie on.
        """
        height, width = self.depth.shape
        focal, principal = self.camera.focal, self.camera.principal
        screen = self.camera.project(points)
        x, y, z = screen[:, 0], screen[:, 1], screen[:, 2]
        column = jnp.clip(jnp.floor(x), 0, width - 1)
        row = jnp.clip(jnp.floor(y), 0, height - 1)
        ray_x = (column + 0.5 - principal[0]) / focal
        ray_y = (principal[1] - row - 0.5) / focal
        nx, ny, nz = face_normals[:, 0], face_normals[:, 1], face_normals[:, 2]
        slope = jnp.minimum(nx * ray_x + ny * ray_y - nz, -1e-3)
        height_above = nx * points[:, 0] + ny * points[:, 1] + nz * points[:, 2]
        pixel = z / focal
        # At a glancing angle the plane may run away within a pixel; the point itself bounds it.
        plane = jnp.clip(height_above / slope, z - _STEEPEST * pixel, z + _STEEPEST * pixel)
        tolerance = 0.5 * pixel * (1.0 + jnp.minimum(-1.0 / slope, _STEEPEST))
        index = row.astype(jnp.int32) * width + column.astype(jnp.int32)
        nearest = jnp.reshape(self.depth, -1).at[index].get(mode="promise_in_bounds")
        inside = (x >= 0) & (x <= width) & (y >= 0) & (y <= height) & (z > 0)
        return jax.lax.stop_gradient(inside & (nearest > plane - tolerance))


def depth_buffer(
    vertices: Float[Array, "n 3"],
    faces: Int[Array, "f 3"],
    camera: Camera,
    height: int,
    width: int,
    longest: int = 512,
) -> DepthBuffer:
    """Depth buffer of a mesh in the camera's frame (mm), without a derivative.

    Args:
        vertices: posed, mm.
        faces: triangles; both sides hide what is behind.
        camera: the photo's projection.
        height: rows of the photo.
        width: columns of the photo.
        longest: the buffer's longer side, px; a smaller photo keeps its own size.

    Raises:
        ValueError: ``longest`` is below 1, or ``rasterize`` does not accept the arrays.
    """
    if longest < 1:
        raise ValueError(f"longest is {longest}; it needs 1 px or more")
    scale = min(1.0, longest / max(height, width))
    size = math.ceil(height * scale), math.ceil(width * scale)
    own = camera.scaled(scale)
    fragments = rasterize(jax.lax.stop_gradient(own.project(vertices)), faces, *size)
    return DepthBuffer(jax.lax.stop_gradient(fragments.depth), own, scale)
