"""The perspective camera (the map Pi_P of Saito 2017, section 3) and the rigid pose."""

import equinox as eqx
import jax.numpy as jnp

from jaxface._types import Array, Float
from jaxface.geometry.rotation import rotation_matrix


class Pose(eqx.Module):
    """Rigid motion from the model's frame to the camera's: ``x_camera = R x + t``."""

    rotation: Float[Array, "3"]
    """axis-angle, radians"""
    translation: Float[Array, "3"]
    """millimetres; z is negative for a face in front of the camera"""

    def __call__(self, points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Points in the camera's frame (mm)."""
        return points @ rotation_matrix(self.rotation).T + self.translation


class Camera(eqx.Module):
    """Pinhole camera with square pixels: looks along -z, x right and y up in its own frame."""

    focal: Float[Array, ""]
    """focal length, pixels"""
    principal: Float[Array, "2"]
    """principal point (x, y), pixels, origin at the top-left corner of the image"""

    @staticmethod
    def from_field_of_view(degrees: float, height: int, width: int) -> "Camera":
        """Camera centred on an image, with the given field of view along its longer side."""
        longer = max(height, width)
        focal = 0.5 * longer / jnp.tan(jnp.deg2rad(degrees) / 2)
        return Camera(jnp.asarray(focal), jnp.array([width / 2.0, height / 2.0]))

    def project(self, points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Camera-frame points (mm) to ``(x px, y px, depth mm)``, y down, depth = -z.

        Points at or behind the camera plane come back with a non-positive depth; their x and y
        are finite but mean nothing, and the rasteriser drops every triangle that has one.
        """
        depth = -points[..., 2]
        inverse = 1.0 / jnp.where(depth > 0, depth, 1.0)
        x = self.principal[0] + self.focal * points[..., 0] * inverse
        y = self.principal[1] - self.focal * points[..., 1] * inverse
        return jnp.stack([x, y, depth], axis=-1)

    def scaled(self, factor: float) -> "Camera":
        """The same camera for an image resized by ``factor``."""
        return Camera(self.focal * factor, self.principal * factor)

    def cropped(self, origin: Float[Array, "2"]) -> "Camera":
        """The same camera for a crop whose top-left corner is at ``origin`` (x, y) px."""
        return Camera(self.focal, self.principal - origin)
