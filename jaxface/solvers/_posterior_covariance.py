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
    without a factor, the ridge is raised tenfold until it has one.
    """
    scale = 1.0 / jnp.sqrt(jnp.maximum(jnp.diagonal(curvature), 1e-30))
    unit = curvature * scale[:, None] * scale
    eye = jnp.eye(len(curvature), dtype=scale.dtype)

    def factorised(ridge: Array) -> Array:
        return jnp.linalg.cholesky(unit + ridge * eye)

    def raised(state: tuple[Array, Array]) -> tuple[Array, Array]:
        ridge = 10.0 * state[0]
        return ridge, factorised(ridge)

    def missing(state: tuple[Array, Array]) -> Array:
        return ~jnp.all(jnp.isfinite(state[1])) & (state[0] < GIVEN_UP)

    ridge = jnp.asarray(RIDGE, scale.dtype)
    _, factor = jax.lax.while_loop(missing, raised, (ridge, factorised(ridge)))
    inverse = cho_solve((factor, True), eye)
    return 0.5 * temperature * inverse * scale[:, None] * scale
