"""Least squares over non-negative unknowns, from the normal equations."""

import jax
import jax.numpy as jnp

from jaxface._types import Array, Float


def nonnegative_least_squares(
    gram: Float[Array, "k k"], moment: Float[Array, "k"], *, steps: int = 300
) -> Float[Array, "k"]:
    """The ``x >= 0`` that minimises ``x^T G x - 2 b^T x``, for instance ``||A x - y||^2``.

    With ``G = A^T A`` and ``b = A^T y``. Accelerated projected gradient (Beck & Teboulle, "A fast
    iterative shrinkage-thresholding algorithm for linear inverse problems", SIAM J. Imaging Sci.
    2009) on unknowns scaled to a unit diagonal, restarted where the momentum climbs (O'Donoghue &
    Candes, "Adaptive restart for accelerated gradient schemes", Found. Comput. Math. 2015). Runs
    under jit, vmap and both modes of differentiation. First order: with columns that are nearly
    alike the objective settles long before the unknowns do.

    Args:
        gram: symmetric, positive semidefinite.
        moment: b.
        steps: projected gradient steps.
    """
    diagonal = jnp.diagonal(gram)
    scale = jax.lax.rsqrt(jnp.maximum(diagonal, 1e-12 * jnp.max(diagonal) + 1e-30))
    unit = gram * scale[:, None] * scale
    # The largest eigenvalue is at most the largest sum of a row.
    rate = 1.0 / jnp.maximum(jnp.max(jnp.sum(jnp.abs(unit), axis=1)), 1e-30)
    goal = moment * scale

    def step(carry: tuple[Array, Array, Array], _: None) -> tuple[tuple[Array, Array, Array], None]:
        x, ahead, momentum = carry
        slope = unit @ ahead - goal
        new = jnp.maximum(ahead - rate * slope, 0.0)
        climbs = jnp.sum((ahead - new) * (new - x)) > 0
        grown = 0.5 * (1 + jnp.sqrt(1 + 4 * momentum**2))
        factor = jnp.where(climbs, 0.0, (momentum - 1) / grown)
        return (new, new + factor * (new - x), jnp.where(climbs, 1.0, grown)), None

    start = jnp.zeros_like(goal)
    one = jnp.ones((), goal.dtype)
    (x, _, _), _ = jax.lax.scan(step, (start, start, one), None, length=steps)
    return x * scale
