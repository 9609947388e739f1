"""The Gaussian that a quadratic energy stands for."""

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve

from jaxface._types import Array, Float

RIDGE = 1e-7
"""share of the diagonal that is added to it"""
GIVEN_UP = 1e9
"""ridge beyond which nothing finite can be missing a factor"""


def posterior_covariance(
    curvature: Float[Array, "p p"], temperature: float | Float[Array, ""]
) -> Float[Array, "p p"]:
    """Covariance ``T/2 C^-1`` of the Gaussian whose density is ``exp(-E/T)``.

    For ``E ~ d^T C d`` around the minimum, ``-log p = E/T`` makes ``C`` half the Hessian
    of ``E`` and the covariance the inverse of ``2C/T``. ``C`` is scaled to unit diagonal, a ridge
    of 1e-7 is added to that, which bounds the variance of what ``C`` leaves open, and the sum is
    inverted by its Cholesky factor. Where rounding, or a point that is no minimum, leaves the sum
    without a factor, the ridge is raised tenfold until it has one, a choice that no derivative
    follows.
    """
    scale = 1.0 / jnp.sqrt(jnp.maximum(jnp.diagonal(curvature), 1e-30))
    unit = curvature * scale[:, None] * scale
    eye = jnp.eye(len(curvature), dtype=scale.dtype)

    # The choice of the ridge is held by every derivative, so that both modes pass.
    held = jax.lax.stop_gradient(unit)

    def missing(ridge: Array) -> Array:
        factor = jnp.linalg.cholesky(held + ridge * eye)
        return ~jnp.all(jnp.isfinite(factor)) & (ridge < GIVEN_UP)

    ridge = jax.lax.while_loop(missing, lambda r: 10.0 * r, jnp.asarray(RIDGE, scale.dtype))
    factor = jnp.linalg.cholesky(unit + ridge * eye)
    inverse = cho_solve((factor, True), eye)
    return 0.5 * temperature * inverse * scale[:, None] * scale
