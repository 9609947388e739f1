"""Rotations: axis-angle parameters, matrices, and the closed-form alignment of point sets."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxface._numerics import LEVI_CIVITA, safe_arctan2, safe_divide, safe_norm
from jaxface._types import Array, Float
from jaxface.geometry.nearest_rotation import nearest_rotation


def _skew(v: Float[Array, "3"]) -> Float[Array, "3 3"]:
    return jnp.tensordot(jnp.asarray(-LEVI_CIVITA, v.dtype), v, 1, precision="highest")


@functools.partial(jax.jit, inline=True)
def rotation_matrix(axis_angle: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Rodrigues' formula ``R = I + a [w]x + b [w]x^2`` for the rotation vector ``w`` (radians).

    ``a = sin(t)/t`` and ``b = (1 - cos t)/t^2`` with ``t = |w|`` are replaced by their Taylor
    series for ``t^2 < 1e-3`` (truncation below 2e-14), so all derivatives exist at the identity.
    """
    t2 = jnp.sum(axis_angle * axis_angle)
    small = t2 < 1e-3
    safe = jnp.where(small, 1.0, t2)
    t = jnp.sqrt(safe)
    a_taylor = 1.0 + t2 * (-1.0 / 6.0 + t2 * (1.0 / 120.0 - t2 / 5040.0))
    b_taylor = 0.5 + t2 * (-1.0 / 24.0 + t2 * (1.0 / 720.0 - t2 / 40320.0))
    a = jnp.where(small, a_taylor, jnp.sin(t) / t)
    b = jnp.where(small, b_taylor, (1.0 - jnp.cos(t)) / safe)
    k = _skew(axis_angle)
    return jnp.eye(3, dtype=axis_angle.dtype) + a * k + b * (k @ k)


def axis_angle(matrix: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Rotation vector (radians, norm at most pi) of a rotation matrix, by way of its quaternion.

    The quaternion is read from its largest component (Shepperd 1978), so angles near 0 and near
    pi are both accurate; at exactly pi the sign of the axis is arbitrary.
    """
    m = matrix
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    q = jnp.array(
        [
            [1.0 + trace, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], 1.0 + 2 * m[0, 0] - trace, m[1, 0] + m[0, 1], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[1, 0] + m[0, 1], 1.0 + 2 * m[1, 1] - trace, m[2, 1] + m[1, 2]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2], 1.0 + 2 * m[2, 2] - trace],
        ]
    )
    row = q[jnp.argmax(jnp.diagonal(q))]
    row = row / jnp.sqrt(jnp.sum(row * row))  # at least 1 for a rotation
    row = jnp.where(row[0] < 0, -row, row)
    w, v = row[0], row[1:]
    s2 = jnp.sum(v * v)
    small = s2 < 1e-8
    s = jnp.sqrt(jnp.where(small, 1.0, s2))
    factor = jnp.where(small, 2.0 / jnp.where(small, w, 1.0), 2.0 * jnp.arctan2(s, w) / s)
    return factor * v


def similarity_transform(
    source: Float[Array | np.ndarray, "n 3"],
    target: Float[Array | np.ndarray, "n 3"],
    weights: Float[Array | np.ndarray, "n"] | None = None,
    with_scale: bool = True,
) -> tuple[
    Float[Array | np.ndarray, ""], Float[Array | np.ndarray, "3 3"], Float[Array | np.ndarray, "3"]
]:
    """Scale ``s``, rotation ``R`` and translation ``t`` minimising ``sum w |s R x + t - y|^2``.

    Umeyama, "Least-squares estimation of transformation parameters between two point
    patterns", PAMI 1991, with a reflection guarded against. Apply as ``s * x @ R.T + t``.
    Without extent the scale is 1, without a positive weight all of the result is the identity.

    Points in NumPy arrays are aligned on the host, in double precision; in JAX arrays, in their
    own, and differentiably.

    Raises:
        ValueError: the sets differ in shape or have fewer than 3 points; or, on the host, the
            source has no extent.
    """
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3:
        raise ValueError(f"source {source.shape} and target {target.shape}; both need (n, 3)")
    if len(source) < 3:
        raise ValueError(f"{len(source)} point pairs; at least 3 are needed")
    if not isinstance(source, jax.Array) and not isinstance(target, jax.Array):
        return _similarity_on_host(source, target, weights, with_scale)
    w = jnp.ones(source.shape[0], source.dtype) if weights is None else jnp.asarray(weights)
    w = safe_divide(w, jnp.sum(w))
    mean_source = w @ source
    mean_target = w @ target
    x, y = source - mean_source, target - mean_target
    # Points that coincide leave differences behind that are no more than their rounding.
    least = (16 * jnp.finfo(x.dtype).eps) ** 2 * jnp.sum(w[:, None] * source * source)
    x = jnp.where(jnp.sum(w[:, None] * x * x) > jax.lax.stop_gradient(least), x, 0.0)
    moment = (w[:, None] * y).T @ x
    rotation = nearest_rotation(moment)
    scale = jnp.ones((), source.dtype)
    if with_scale:
        # The trace is the sum of the singular values, the last one signed.
        variance = jnp.sum(w[:, None] * x * x)
        scale = safe_divide(jnp.sum(rotation * moment), variance, 1.0)
    return scale, rotation, mean_target - scale * rotation @ mean_source


def _similarity_on_host(source: Any, target: Any, weights: Any, with_scale: bool) -> Any:
    source, target = (np.asarray(points, np.float64) for points in (source, target))
    w = np.ones(len(source)) if weights is None else np.asarray(weights, np.float64)
    w = w / np.sum(w)
    mean_source, mean_target = w @ source, w @ target
    x, y = source - mean_source, target - mean_target
    variance = np.sum(w[:, None] * x * x)
    if variance == 0:
        raise ValueError("all source points are the same; they need some extent")
    u, singular, vt = np.linalg.svd((w[:, None] * y).T @ x)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    scale = np.asarray(np.sum(singular * sign) / variance if with_scale else 1.0)
    return scale, rotation, mean_target - scale * rotation @ mean_source


@functools.partial(jax.jit, inline=True)
def euler_yxz(matrix: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """(yaw, pitch, roll) in radians with ``R = Ry(yaw) Rx(pitch) Rz(roll)``.

    Yaw is positive when the face turns to its own left (image right), pitch when it looks down.
    At the pole, a pitch of a right angle, yaw and roll turn about one axis: there the two are zero
    and the derivative of all three is taken as zero where it does not exist.
    """
    m = matrix
    # By its tangent rather than its sine, which loses half the digits, and its slope, at the pole.
    pitch = safe_arctan2(-m[1, 2], safe_norm(jnp.stack([m[0, 2], m[2, 2]])))
    return jnp.stack([safe_arctan2(m[0, 2], m[2, 2]), pitch, safe_arctan2(m[1, 0], m[1, 1])])


rotation_matrices = jax.vmap(rotation_matrix)
