"""L-BFGS driven from the host: one compiled evaluation, and a state that can be kept and resumed.

For energies whose single evaluation takes from milliseconds to minutes. The energy is compiled
once, alone, and not once for every place where a jitted line search calls it; between steps the
caller can look at the point, write it to disk, or stop.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxface._types import Array, Float, PyTree
from jaxface.solvers.finiteness import holds_no_number

ValueAndGrad = Callable[[Array, PyTree], tuple[Array, Array]]


class LBFGSState(NamedTuple):
    """Everything a run needs to go on: plain arrays, the latest pair of the memory last."""

    y: Float[Array, "n"]
    value: Float[Array, ""]
    gradient: Float[Array, "n"]
    steps: Float[Array, "m n"]
    """differences of the last points"""
    changes: Float[Array, "m n"]
    """differences of their gradients"""
    pairs: int
    """how many rows of the memory are in use"""
    evaluations: int


def lbfgs_start(value_and_grad: ValueAndGrad, y: Array, args: PyTree, memory: int) -> LBFGSState:
    """The state before the first step (one evaluation)."""
    value, gradient = value_and_grad(y, args)
    empty = jnp.zeros((memory, y.size), y.dtype)
    return LBFGSState(y, value, gradient, empty, empty, 0, 1)


def lbfgs_step(
    value_and_grad: ValueAndGrad,
    state: LBFGSState,
    args: PyTree,
    *,
    first_change: float = 0.05,
    trials: int = 12,
) -> tuple[LBFGSState, bool]:
    """One step: two-loop direction, then backtracking to a sufficient decrease.

    Nocedal and Wright, "Numerical Optimization", algorithms 7.4 and 3.1, with the step of the
    quadratic through the last trial. A pair that does not show positive curvature is not
    remembered, so the direction always descends. A point where the value or the gradient is not
    finite is never taken.

    Args:
        value_and_grad: of ``(y, args)``, compiled.
        state: from ``lbfgs_start`` or the last step.
        args: problem data.
        first_change: of the first step, which has no scale yet, the largest change of an entry.
        trials: evaluations before the search gives up.

    Returns:
        The next state, and whether a lower point was found. If not, the memory is empty: a
        further step tries the gradient; where that fails too there is nothing left to gain.
    """
    direction, slope = _direction(state.gradient, state.steps, state.changes, state.pairs)
    length = 1.0
    if state.pairs == 0:
        largest = float(jnp.max(jnp.abs(direction)))
        length = first_change / largest if largest > 0 else 0.0
    start, slope = float(state.value), float(slope)
    evaluations = state.evaluations
    for _ in range(trials if slope < 0 else 0):
        y = _along(state.y, direction, length)
        value, gradient = value_and_grad(y, args)
        evaluations += 1
        reached = float(value)
        if not math.isfinite(reached) or holds_no_number(gradient):
            length *= 0.1
            continue
        if reached <= start + 1e-4 * length * slope:
            kept = _remember(state, y, gradient)
            return LBFGSState(y, value, gradient, *kept, evaluations), True
        parabola = -slope * length**2 / (2 * (reached - start - length * slope))
        length = min(max(parabola, 0.1 * length), 0.5 * length)
    return state._replace(pairs=0, evaluations=evaluations), False


@jax.jit
def _direction(gradient: Array, steps: Array, changes: Array, pairs: Array) -> tuple[Array, Array]:
    """Minus the inverse Hessian's estimate times the gradient, and the slope along it."""
    memory = steps.shape[0]
    used = jnp.arange(memory) >= memory - pairs
    curvature = jnp.sum(steps * changes, axis=1)
    inverse = jnp.where(used, 1.0 / jnp.where(used, curvature, 1.0), 0.0)

    def backward(q: Array, row: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        s, c, rho = row
        alpha = rho * (s @ q)
        return q - alpha * c, alpha

    rows = (steps, changes, inverse)
    q, alphas = jax.lax.scan(backward, gradient, rows, reverse=True)
    last = jnp.sum(changes[-1] ** 2)
    q = q * jnp.where(pairs > 0, curvature[-1] / jnp.where(last > 0, last, 1.0), 1.0)

    def forward(r: Array, row: tuple[Array, Array, Array, Array]) -> tuple[Array, None]:
        s, c, rho, alpha = row
        return r + s * (alpha - rho * (c @ r)), None

    r, _ = jax.lax.scan(forward, q, (*rows, alphas))
    return -r, -(r @ gradient)


@jax.jit
def _along(y: Array, direction: Array, length: float) -> Array:
    return y + jnp.asarray(length, y.dtype) * direction


def _remember(state: LBFGSState, y: Array, gradient: Array) -> tuple[Array, Array, int]:
    steps, changes, curved = _newer(
        state.steps, state.changes, y, state.y, gradient, state.gradient
    )
    if not bool(curved):
        return state.steps, state.changes, state.pairs
    return steps, changes, min(state.pairs + 1, len(steps))


@jax.jit
def _newer(
    steps: Array, changes: Array, y: Array, last: Array, gradient: Array, last_gradient: Array
) -> tuple[Array, Array, Array]:
    """The memory with a new pair, and whether that shows positive curvature."""
    step, change = y - last, gradient - last_gradient
    enough = 1e-7 * jnp.linalg.norm(step) * jnp.linalg.norm(change)
    steps = jnp.concatenate([steps[1:], step[None]])
    changes = jnp.concatenate([changes[1:], change[None]])
    return steps, changes, step @ change > enough
