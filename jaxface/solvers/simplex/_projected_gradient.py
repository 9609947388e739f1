"""Accelerated projected gradient over the simplex, by jaxopt: the plain method, for comparison."""

import jax.numpy as jnp

from jaxface._numerics import safe_norm
from jaxface._types import Array, Float
from jaxface.solvers.jaxopt_import import jaxopt
from jaxface.solvers.simplex._working_set import Found, closed, improved, started
from jaxface.solvers.simplex.certificate import residuals


def projected_gradient(
    points: Float[Array, "k l m"],
    weights: Float[Array, " k"],
    tolerance: Float[Array, ""],
    floor: Float[Array, ""],
    *,
    squared: bool,
    steps: int = 2000,
) -> Found:
    """Minimise the sum of norms (or of squares) by at most ``steps`` accelerated gradient steps.

    Beck and Teboulle, "A fast iterative shrinkage-thresholding algorithm for linear inverse
    problems" (2009), as ``jaxopt.ProjectedGradient`` has it. Stops when its own step is below the
    square root of the tolerance; the certified gap is whatever was reached, on correlated points
    seldom below 1e-2. The best point is of the last step only.
    """

    def energy(weights: Array, points: Array) -> Array:
        r = residuals(points, weights)
        return jnp.sum(r * r) if squared else jnp.sum(safe_norm(r))

    module = jaxopt()
    solver = module.ProjectedGradient(
        energy, module.projection.projection_simplex, maxiter=steps, tol=1e-8, unroll=False,
        implicit_diff=False,
    )  # fmt: skip
    answer, state = solver.run(weights, points=points)
    found = started(points, weights, tolerance, floor)
    found, _ = improved(found, answer / jnp.sum(answer), jnp.zeros_like(points[0]), points)
    return found._replace(
        rounds=jnp.asarray(1),
        steps=jnp.asarray(state.iter_num, found.steps.dtype),
        converged=closed(found.certificate, tolerance, floor),
    )
