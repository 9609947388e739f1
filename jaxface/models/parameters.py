"""The unknowns of a fit, ``chi = {V, I, R, t, P, L}`` of Saito 2017, section 3, as one pytree."""

import equinox as eqx
import jax.numpy as jnp

from jaxface._types import Array, Float
from jaxface.geometry.camera import Camera, Pose
from jaxface.models.morphable import MorphableModel


class FaceParameters(eqx.Module):
    """Everything a fit estimates. Coefficients count standard deviations (``alpha / sigma``)."""

    identity: Float[Array, "i"]
    expression: Float[Array, "e"]
    albedo: Float[Array, "a"]
    light: Float[Array, "9 3"]
    """irradiance coefficients of the real spherical harmonics, one column a colour channel,
    in the camera's frame"""
    rotation: Float[Array, "3"]
    """axis-angle, radians"""
    translation: Float[Array, "3"]
    """mm, in the camera's frame"""
    log_focal: Float[Array, ""]
    """logarithm of the focal length in units of the working image's side"""

    @property
    def pose(self) -> Pose:
        """The rigid motion from the model's frame to the camera's."""
        return Pose(self.rotation, self.translation)

    def camera(self, principal: Float[Array, "2"], size: float | Float[Array, ""] = 1.0) -> Camera:
        """The camera of a square working image.

        Args:
            principal: principal point as fractions of the side; it is (0.5, 0.5) only where the
                working image is centred in the photo.
            size: side in pixels; 1 gives a camera in fractions of the side.
        """
        return Camera(jnp.exp(self.log_focal) * size, principal * size)


def neutral_parameters(model: MorphableModel, field_of_view: float = 30.0) -> FaceParameters:
    """The mean face under a white ambient light, 60 cm in front of the camera.

    Args:
        model: the model whose coefficient counts are taken.
        field_of_view: degrees across the working image.
    """
    dtype = model.mean.dtype
    return FaceParameters(
        identity=jnp.zeros(model.identity.count, dtype),
        expression=jnp.zeros(model.expression.count, dtype),
        albedo=jnp.zeros(model.albedo.count, dtype),
        light=jnp.zeros((9, 3), dtype).at[0].set(1.0),
        rotation=jnp.zeros(3, dtype),
        translation=jnp.array([0.0, 0.0, -600.0], dtype),
        log_focal=jnp.asarray(-jnp.log(2 * jnp.tan(jnp.deg2rad(field_of_view) / 2)), dtype),
    )
