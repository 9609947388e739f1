"""Nonlinear least squares on any residual, by optimistix."""

from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree

from jaxface._types import Array, Bool, PyTree
from jaxface.solvers.finiteness import TOTAL, NotFinite, flags, holds_no_number
from jaxface.solvers.solution import Solution, stopped

_SOLVERS = {
    "levenberg_marquardt": optx.LevenbergMarquardt,
    "gauss_newton": optx.GaussNewton,
    "dogleg": optx.Dogleg,
}


def least_squares(
    fn: Callable[[PyTree, PyTree], PyTree],
    y0: PyTree,
    args: PyTree = None,
    *,
    method: Literal["levenberg_marquardt", "gauss_newton", "dogleg"] = "levenberg_marquardt",
    steps: int = 100,
    rtol: float = 1e-5,
    atol: float = 1e-6,
) -> Solution:
    """Minimise ``||fn(y, args)||^2``.

    Differentiable with respect to ``args`` by the implicit function theorem.

    Args:
        fn: the residual, a pytree of arrays; ``Energy.residual`` of composed terms fits.
        y0: start.
        args: problem data.
        method: Levenberg-Marquardt, plain Gauss-Newton, or Powell's dogleg.
        steps: greatest number of steps.
        rtol: relative tolerance on the step and on the energy.
        atol: absolute tolerance on the same.

    Returns:
        ``stats``: ``num_steps``, ``max_steps`` and ``not_finite``, see `Solution`; where the
        residual is a dict, by name of its entries. In float32 ``rtol`` below 1e-5 is not reached.

    Raises:
        ValueError: an unknown method, or a complex residual.
    """
    if method not in _SOLVERS:
        raise ValueError(f"method is {method!r}; it must be one of {sorted(_SOLVERS)}")
    solver = _SOLVERS[method](rtol=rtol, atol=atol)
    shapes = jax.eval_shape(fn, y0, args)
    if any(jnp.issubdtype(leaf.dtype, jnp.complexfloating) for leaf in jax.tree.leaves(shapes)):
        raise ValueError(
            "the residual is complex; it must be real: give real and imaginary parts apart"
        )
    found = optx.least_squares(fn, solver, y0, args, max_steps=steps, throw=False)
    not_finite, flat_out = _looked_at(fn, *jax.lax.stop_gradient((found.value, args)))
    broken = jnp.any(not_finite[TOTAL])
    # Its own result looks at steps and energies alone, and takes a failed search for convergence.
    start, end = ravel_pytree(y0)[0], ravel_pytree(found.value)[0]
    still = jnp.all(start == end) & ~flat_out
    good = (found.result == optx.RESULTS.successful) & ~still
    stuck = still & (found.result != optx.RESULTS.nonlinear_max_steps_reached)
    stats = {**found.stats, "not_finite": not_finite}
    return Solution(found.value, stopped(broken, good, stuck), stats)


def _looked_at(
    fn: Callable[[PyTree, PyTree], PyTree], y: PyTree, args: PyTree
) -> tuple[NotFinite, Bool[Array, ""]]:
    """Flags of the residual and of its Jacobian, and whether the gradient is small."""
    flat, unravel = ravel_pytree(y)

    def named(flat: Array) -> tuple[dict[str, PyTree], dict[str, PyTree]]:
        out = fn(unravel(flat), args)
        out = {str(k): v for k, v in out.items()} if isinstance(out, dict) else {TOTAL: out}
        return out, out

    jacobian, residual = jax.jacfwd(named, has_aux=True)(flat)
    found = {
        name: flags(holds_no_number(r), holds_no_number(jacobian[name]))
        for name, r in residual.items()
    }
    whole = jnp.any(jnp.stack(list(found.values())), axis=0) | flags(holds_no_number(y))
    pairs = zip(jax.tree.leaves(residual), jax.tree.leaves(jacobian), strict=True)
    gradient = sum((jnp.tensordot(r, j, r.ndim) for r, j in pairs), jnp.zeros_like(flat))
    energy = sum(jnp.sum(jnp.square(r)) for r in jax.tree.leaves(residual))
    slope = jnp.max(jnp.abs(gradient)) * jnp.max(jnp.abs(flat))
    return {**found, TOTAL: whole}, slope <= float(jnp.finfo(flat.dtype).eps) ** 0.5 * energy
