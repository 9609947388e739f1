"""The unknowns of a fit, ``chi = {V, I, R, t, P, L}`` of Saito 2017, section 3, as one pytree."""

import dataclasses
from collections.abc import Collection

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Float, Int
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


PARAMETER_NAMES = tuple(field.name for field in dataclasses.fields(FaceParameters))
"""the fields of ``FaceParameters``, in the order in which they are flattened"""


def set_apart(
    y: FaceParameters, names: Collection[str]
) -> tuple[FaceParameters, FaceParameters | None]:
    """The unknowns without some fields, and these alone: what is missing is None in each.

    ``put_together`` is the way back. With the first as its unknowns a solver does
    not know of the others, so that its steps, and derivatives of its answer, hold them exactly.

    Args:
        y: all unknowns.
        names: of the fields to be held; with none of them the second part is None.

    Raises:
        ValueError: a name is no field of ``FaceParameters``.
    """
    unknown = sorted(set(names) - set(PARAMETER_NAMES))
    if unknown:
        raise ValueError(f"there are no unknowns {unknown}; there are {list(PARAMETER_NAMES)}")
    if not names:
        return y, None
    free = jax.tree.structure(y).unflatten([name not in names for name in PARAMETER_NAMES])
    return eqx.partition(y, free)


def put_together(free: FaceParameters, held: FaceParameters | None) -> FaceParameters:
    """All unknowns again, from the two parts that ``set_apart`` gives."""
    return free if held is None else eqx.combine(free, held)


def free_columns(y: FaceParameters, names: Collection[str]) -> Int[np.ndarray, "f"]:
    """Where the flattened unknowns keep all but some fields, as indices.

    Args:
        y: all unknowns, or their shapes.
        names: of the fields that are left out.
    """
    free = [np.full(np.size(getattr(y, name)), name not in names) for name in PARAMETER_NAMES]
    return np.flatnonzero(np.concatenate(free))
