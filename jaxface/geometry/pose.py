"""Head pose from landmarks in closed form."""

import jax
import jax.numpy as jnp

from jaxface._numerics import safe_divide
from jaxface._types import Array, Float
from jaxface.geometry.nearest_rotation import rotation_change
from jaxface.geometry.rotation import axis_angle


def pose_from_landmarks(
    points: Float[Array, "l 3"],
    target: Float[Array, "l 2"],
    weight: Float[Array, "l"],
    focal: Float[Array, ""],
    principal: Float[Array, "2"],
    sweeps: int = 3,
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Rotation and translation whose perspective projection of ``points`` meets ``target``.

    A scaled-orthographic pose in closed form (affine least squares, then the nearest scaled
    rotation by SVD), lifted to perspective by POSIT sweeps: image points are corrected by the
    relative depth of each point and the linear problem is solved again (DeMenthon & Davis,
    "Model-based object pose in 25 lines of code", IJCV 1995).

    Args:
        points: landmarks on the model, mm, in the model's frame; not all in one plane.
        target: their image positions (x right, y down).
        weight: non-negative weights.
        focal: focal length in the unit of ``target``.
        principal: principal point in the unit of ``target``.
        sweeps: POSIT corrections.

    Returns:
        Axis-angle rotation (radians) and translation (mm) to the camera's frame.
    """
    share = safe_divide(weight, jnp.sum(weight))
    centre = share @ points
    x = points - centre
    gram = (x * share[:, None]).T @ x
    gram = gram + 1e-6 * jnp.trace(gram) * jnp.eye(3, dtype=x.dtype)
    # Of points that coincide no more than rounding is left: any pose is theirs.
    least = (16 * jnp.finfo(x.dtype).eps) ** 2 * jnp.sum(share[:, None] * points * points)
    gram = jnp.where(
        jnp.trace(gram) > jax.lax.stop_gradient(least), gram, jnp.eye(3, dtype=x.dtype)
    )
    flip = jnp.array([1.0, -1.0], target.dtype)
    observed = (target - principal) * flip / focal
    stretch = jnp.ones(points.shape[0], points.dtype)
    rotation, translation = jnp.eye(3, dtype=x.dtype), jnp.zeros(3, x.dtype)
    for _ in range(sweeps + 1):
        image = observed * stretch[:, None]
        image_centre = share @ image
        affine = jnp.linalg.solve(gram, (x * share[:, None]).T @ (image - image_centre)).T
        rotation, scale = _scaled_rotation(affine)
        scale = jnp.maximum(scale, 1e-12)
        depth = 1.0 / scale
        middle = jnp.stack([image_centre[0] * depth, image_centre[1] * depth, -depth])
        translation = middle - rotation @ centre
        # depth of each point over the depth of the centre
        stretch = 1.0 - (x @ rotation[2]) / depth
    return axis_angle(rotation), translation


@jax.custom_jvp
def _scaled_rotation(affine: Float[Array, "2 3"]) -> tuple[Float[Array, "3 3"], Float[Array, ""]]:
    """The rotation whose first two rows, times the scale, are nearest to a matrix; and the scale.

    The scale is the mean singular value, ``tr(R^T [A; 0]) / 2``.
    """
    u, singular, vt = jnp.linalg.svd(affine, full_matrices=False)
    rows = u @ vt
    rotation = jnp.concatenate([rows, jnp.cross(rows[0], rows[1])[None]])
    return rotation, jnp.mean(singular)


@_scaled_rotation.defjvp
def _scaled_rotation_jvp(
    primals: tuple[Array], tangents: tuple[Array]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    (affine,), (change,) = primals, tangents
    rotation, scale = _scaled_rotation(affine)
    whole, moved = (jnp.concatenate([m, jnp.zeros_like(m[:1])]) for m in (affine, change))
    turned = rotation_change(rotation, whole, moved)
    return (rotation, scale), (turned, 0.5 * jnp.sum(rotation * moved))
