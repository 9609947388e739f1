"""Minimise any smooth energy by L-BFGS: ours, jaxopt's or optimistix's, behind one call."""

from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree

from jaxface._types import Array, PyTree
from jaxface.solvers.jaxopt_import import jaxopt
from jaxface.solvers.lbfgs import LBFGSState, lbfgs_start, lbfgs_step
from jaxface.solvers.solution import Solution

Method = Literal["lbfgs", "jaxopt", "optimistix"]
METHODS: tuple[Method, ...] = ("lbfgs", "jaxopt", "optimistix")


def minimise(
    fn: Callable[[PyTree, PyTree], Array],
    y0: PyTree,
    args: PyTree = None,
    *,
    method: Method = "lbfgs",
    steps: int = 100,
    memory: int = 10,
    rtol: float = 1e-5,
    on_step: Callable[[int, LBFGSState], bool | None] | None = None,
    state: LBFGSState | None = None,
    first_change: float = 0.05,
) -> Solution:
    """Minimise ``fn(y, args)``, a scalar, over the pytree ``y``.

    ``"lbfgs"`` runs on the host around one compiled evaluation and is the default: it needs the
    fewest evaluations and by far the least compilation, and can be watched and resumed.
    ``"jaxopt"`` (zoom line search) and ``"optimistix"`` run as one program; the latter is
    differentiable with respect to ``args`` by the implicit function theorem.

    Args:
        fn: the energy.
        y0: start.
        args: problem data.
        method: see above.
        steps: greatest number of steps.
        memory: pairs that L-BFGS remembers.
        rtol: stops when ten steps together lower the energy by less than this part of it
            (``"lbfgs"``); tolerance of the gradient's norm (``"jaxopt"``), of step and energy
            (``"optimistix"``).
        on_step: called after each step with its number and the state; True stops. ``"lbfgs"`` only.
        state: of an earlier run of the same problem, to go on from. ``"lbfgs"`` only.
        first_change: largest change of an entry in the first step. ``"lbfgs"`` only.

    Returns:
        ``stats``: ``num_steps``; of ``"lbfgs"`` also ``evaluations``, ``values`` (before the
        first step and after each) and ``state``.

    Raises:
        ValueError: an unknown method, or an option that the method does not have.
        ImportError: jaxopt does not work with the installed JAX.
    """
    if method not in METHODS:
        raise ValueError(f"method is {method!r}; it must be one of {METHODS}")
    if method != "lbfgs" and (on_step is not None or state is not None):
        raise ValueError(f"on_step and state belong to method 'lbfgs', not to {method!r}")
    if method == "jaxopt":
        return _by_jaxopt(fn, y0, args, steps, memory, rtol)
    if method == "optimistix":
        solver = optx.LBFGS(rtol=rtol, atol=rtol, history_length=memory)
        found = optx.minimise(fn, solver, y0, args, max_steps=steps, throw=False)
        return Solution(found.value, found.result, {"num_steps": found.stats["num_steps"]})
    return _on_host(fn, y0, args, steps, memory, rtol, on_step, state, first_change)


def _by_jaxopt(
    fn: Callable[..., Array], y0: PyTree, args: PyTree, steps: int, memory: int, rtol: float
) -> Solution:
    solver = jaxopt().LBFGS(
        fun=fn,
        maxiter=steps,
        history_size=memory,
        tol=rtol,
        linesearch="zoom",
        stop_if_linesearch_fails=True,
    )
    value, last = solver.run(y0, args)
    done = last.error <= rtol
    result = optx.RESULTS.where(
        done, optx.RESULTS.successful, optx.RESULTS.nonlinear_max_steps_reached
    )
    return Solution(value, result, {"num_steps": last.iter_num})


def _on_host(
    fn: Callable[..., Array],
    y0: PyTree,
    args: PyTree,
    steps: int,
    memory: int,
    rtol: float,
    on_step: Callable[[int, LBFGSState], bool | None] | None,
    state: LBFGSState | None,
    first_change: float,
) -> Solution:
    flat, unravel = ravel_pytree(y0)
    evaluate = jax.jit(jax.value_and_grad(lambda y, args: fn(unravel(y), args)))
    current = state or lbfgs_start(evaluate, flat, args, memory)
    values = [float(current.value)]
    result: Any = optx.RESULTS.nonlinear_max_steps_reached
    if not jnp.isfinite(current.value):
        raise ValueError(f"the energy at the start is {values[0]}; it must be finite")
    done, failed = 0, False
    while done < steps:
        current, lower = lbfgs_step(evaluate, current, args, first_change=first_change)
        if not lower and failed:
            result = optx.RESULTS.successful
            break
        failed = not lower
        if failed:
            continue
        done += 1
        values.append(float(current.value))
        if on_step is not None and on_step(done, current):
            break
        if len(values) > 10 and values[-11] - values[-1] <= rtol * abs(values[-1]):
            result = optx.RESULTS.successful
            break
    stats = {
        "num_steps": done,
        "evaluations": current.evaluations,
        "values": values,
        "state": current,
    }
    return Solution(unravel(current.y), result, stats)
