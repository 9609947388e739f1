"""Primal-dual interior point for ``min sum_l ||sum_k w_k p_kl||`` over the simplex.

The norms are handled as by Andersen, Christiansen, Conn and Overton ("An efficient primal-dual
interior-point method for minimizing a sum of Euclidean norms", SIAM J. Sci. Comput. 22, 2000):
``y_l phi_l = r_l`` with ``phi_l = sqrt(||r_l||^2 + delta^2)`` is linearised in ``y_l`` and ``w``
together, so a term whose residual vanishes at the solution costs no more steps than another.
The signs of the weights are handled by Mehrotra's predictor and corrector ("On the implementation
of a primal-dual interior point method", SIAM J. Optim. 2, 1992). A step factorises one
``k x k`` matrix.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax.linalg import cholesky, triangular_solve

from jaxface._types import Array, Bool, Float, Int
from jaxface.solvers.simplex.certificate import residuals


class _State(NamedTuple):
    w: Float[Array, " k"]
    z: Float[Array, " k"]
    y: Float[Array, "l m"]
    step: Int[Array, ""]
    done: Bool[Array, ""]


def interior_point(
    points: Float[Array, "k l m"],
    mask: Bool[Array, " k"],
    tolerance: Float[Array, ""],
    floor: Float[Array, ""],
    *,
    steps: int = 60,
) -> tuple[Float[Array, " k"], Float[Array, "l m"], Int[Array, ""]]:
    """Minimise over the points of ``mask``; the other weights are zero.

    Starts at equal weights. Points should be of order one. Reaches relative gaps of about 1e-13
    in double precision.

    Args:
        points: of the problem; rows outside ``mask`` may be anything finite.
        mask: points that take part, at least one.
        tolerance: stop at this gap, relative to the objective.
        floor: stop at this objective, which counts as zero.
        steps: greatest number of steps.

    Returns:
        Weights (positive, sum one), dual vectors (in the unit ball), steps taken.
    """
    layers = jnp.where(mask[:, None, None], points, 0.0).transpose(1, 0, 2)  # (l, k, m)
    points = layers.transpose(1, 0, 2)
    grams = layers @ layers.transpose(0, 2, 1)
    terms, size = points.shape[1:]
    ones = mask.astype(points.dtype)
    count = jnp.sum(ones)
    # Indices are 32-bit throughout: this is traced in double precision, but may be compiled in
    # a program that knows only single.
    index = jax.lax.iota(jnp.int32, len(mask))
    eye = (index[:, None] == index).astype(points.dtype)
    infinity = jnp.asarray(jnp.inf, points.dtype)

    def room(u: Array, du: Array) -> Array:
        """The longest step up to 1 that keeps ``u + step du >= 0``."""
        blocking = mask & (du < 0)
        ratio = -u / jnp.where(blocking, du, 1.0)
        return jnp.minimum(1.0, jnp.min(jnp.where(blocking, ratio, infinity)))

    def prices_of(y: Array, r: Array) -> tuple[Array, Array]:
        both = layers @ jnp.stack([y, r], axis=-1)  # (l, k, 2)
        return both[..., 0], both[..., 1]

    def least(prices: Array) -> Array:
        return jnp.min(jnp.where(mask, prices, infinity))

    def step(state: _State) -> _State:
        w, z, y, number, _ = state
        r = residuals(points, w)
        norms = jnp.linalg.norm(r, axis=-1)
        objective = jnp.sum(norms)
        a, b = prices_of(y, r)
        inverse = jnp.where(norms > 0, 1.0 / jnp.where(norms > 0, norms, 1.0), 0.0)
        bound = jnp.maximum(least(inverse @ b), least(jnp.sum(a, axis=0)))
        gap = objective - jnp.maximum(bound, 0.0)
        done = (gap <= tolerance * objective) | (objective <= floor)

        mu = jnp.sum(w * z) / count
        phi = jnp.sqrt(norms**2 + (0.3 * mu * count / terms) ** 2 + floor**2)
        gradient = (1.0 / phi) @ b
        cross = (a / (phi**2)[:, None]).T @ b
        hessian = jnp.tensordot(1.0 / phi, grams, 1) - 0.5 * (cross + cross.T)
        # A norm is homogeneous: its Hessian has the null vector w. Since the steps sum to zero, a
        # multiple of 1 1^T changes nothing but the conditioning.
        diagonal = jnp.sum(hessian * eye, axis=0)
        hessian = hessian + jnp.sum(diagonal) / count * ones[:, None] * ones
        ridge = 1e-14 * (jnp.max(diagonal) + jnp.sum(diagonal) / count)
        safe_w = jnp.where(mask, w, 1.0)
        hessian = hessian + eye * jnp.where(mask, z / safe_w + ridge, 1.0)
        factor = cholesky(hessian, symmetrize_input=False)

        def solve(columns: Array) -> Array:
            half = triangular_solve(factor, columns, left_side=True, lower=True)
            return triangular_solve(factor, half, left_side=True, lower=True, transpose_a=True)

        def direction(centre: Array, particular: Array, unit: Array) -> tuple[Array, Array]:
            shift = (jnp.sum(w) - 1.0 + jnp.sum(particular)) / jnp.sum(unit)
            dw = particular - shift * unit
            return dw, jnp.where(mask, centre - z - z / safe_w * dw, 0.0)

        both = solve(jnp.stack([-gradient * ones, ones], axis=1))
        unit = both[:, 1]
        dw, dz = direction(jnp.zeros_like(w), both[:, 0], unit)
        reach = jnp.sum((w + room(w, dw) * dw) * (z + room(z, dz) * dz)) / count
        # No faster towards the boundary than the gap closes, or the dual residual is left behind.
        target = jnp.maximum(mu * (reach / mu) ** 3, 1e-3 * jnp.maximum(gap, 0.0) / count)
        centre = jnp.where(mask, (target - dw * dz) / safe_w, 0.0)
        dw, dz = direction(centre, solve((centre - gradient * ones)[:, None])[:, 0], unit)

        dr = residuals(points, dw)
        inner = jnp.sum(r * dr, axis=-1) / phi
        dy = r / phi[:, None] - y + (dr - y * inner[:, None]) / phi[:, None]
        length = 0.995 * jnp.minimum(room(w, dw), room(z, dz))
        new_w = w + length * dw
        new_w = new_w / jnp.sum(new_w)
        new_z = z + length * dz
        new_y = y + length * dy
        new_y = new_y / jnp.maximum(1.0, jnp.linalg.norm(new_y, axis=-1, keepdims=True))
        finite = jnp.all(jnp.isfinite(new_w)) & jnp.all(jnp.isfinite(new_z))
        keep = done | ~finite | ~jnp.all(jnp.isfinite(new_y))

        def choose(new: Array, old: Array) -> Array:
            return jnp.where(keep, old, new)

        return _State(
            choose(new_w, w),
            choose(new_z, z),
            choose(new_y, y),
            number + (~done).astype(jnp.int32),
            keep,
        )

    w = ones / count
    start = jnp.sum(jnp.linalg.norm(residuals(points, w), axis=-1))
    found = jax.lax.while_loop(
        lambda s: (s.step < steps) & ~s.done,
        step,
        _State(
            w,
            ones * start,
            jnp.zeros((terms, size), points.dtype),
            jnp.asarray(0, jnp.int32),
            start <= floor,
        ),
    )
    return found.w, found.y, found.step
