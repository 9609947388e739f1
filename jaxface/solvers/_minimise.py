"""Minimise any smooth energy by L-BFGS: ours, jaxopt's or optimistix's, behind one call."""

import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jax.core import Tracer
from jax.flatten_util import ravel_pytree

from jaxface._types import Array, PyTree
from jaxface.solvers.finiteness import (
    TOTAL,
    NotFinite,
    NotFiniteError,
    flags,
    holds_no_number,
    not_finite_words,
)
from jaxface.solvers.jaxopt_import import jaxopt
from jaxface.solvers.lbfgs import LBFGSState, lbfgs_start, lbfgs_step
from jaxface.solvers.solution import Solution, stopped

Method = Literal["lbfgs", "jaxopt", "optimistix"]
METHODS: tuple[Method, ...] = ("lbfgs", "jaxopt", "optimistix")


def minimise(
    fn: Callable[[PyTree, PyTree], Any],
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

    ``"lbfgs"`` is ``successful`` where its rule below is met, or where no step lowers the energy
    any more and the gradient is small: ``|g| |y|`` (largest entries) at most ``rtol``, or the root
    of the arithmetic's precision, of the energy or of what it fell by. It never goes to a point
    whose value or gradient is not finite.

    Args:
        fn: the energy: a scalar, or ``(scalar, aux)`` as ``Energy.value`` gives. If ``aux`` is a
            dict of scalars, the terms by name, the result can say which of them was not finite.
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
        ``stats``: ``num_steps``; ``aux`` at the answer, None if there is none; ``not_finite``, see
        `Solution`; of ``"lbfgs"`` also ``evaluations``, ``values`` (before the first step and
        after each), ``state``, and ``watcher``: whether ``on_step`` ended the run.

    Raises:
        ValueError: an unknown method, or an option that the method does not have.
        NotFiniteError: the energy at the start is not finite (``"lbfgs"``; in the others the
            result says so).
        ImportError: jaxopt does not work with the installed JAX.
    """
    if method not in METHODS:
        raise ValueError(f"method is {method!r}; it must be one of {METHODS}")
    if method != "lbfgs" and (on_step is not None or state is not None):
        raise ValueError(f"on_step and state belong to method 'lbfgs', not to {method!r}")

    def parted(y: PyTree, args: PyTree) -> tuple[Array, Any]:
        out = fn(y, args)
        return out if isinstance(out, tuple) else (out, None)

    if method == "jaxopt":
        return _by_jaxopt(parted, y0, args, steps, memory, rtol)
    if method == "optimistix":
        return _by_optimistix(parted, y0, args, steps, memory, rtol)
    return _on_host(parted, y0, args, steps, memory, rtol, on_step, state, first_change)


Parted = Callable[[PyTree, PyTree], tuple[Array, Any]]


def _flags_at(value: Any, aux: Any, gradient: PyTree) -> NotFinite:
    """Flags of the whole energy, and of the values of its terms where ``aux`` names them."""
    terms = aux if isinstance(aux, dict) else {}
    own = {
        name: flags(~jnp.isfinite(part))
        for name, part in terms.items()
        if jnp.shape(part) == () and jnp.issubdtype(jnp.result_type(part), jnp.floating)
    }
    return {**own, TOTAL: flags(~jnp.isfinite(value), holds_no_number(gradient))}


def _by_jaxopt(
    fn: Parted, y0: PyTree, args: PyTree, steps: int, memory: int, rtol: float
) -> Solution:
    solver = jaxopt().LBFGS(
        fun=fn,
        has_aux=True,
        maxiter=steps,
        history_size=memory,
        tol=rtol,
        linesearch="zoom",
        stop_if_linesearch_fails=True,
    )
    found, last = solver.run(y0, args)
    not_finite, value, aux, _ = _ended(fn, y0, found, args)
    broken = jnp.any(not_finite[TOTAL])
    result = stopped(broken, last.error <= rtol, last.failed_linesearch)
    return Solution(
        value, result, {"num_steps": last.iter_num, "aux": aux, "not_finite": not_finite}
    )


def _by_optimistix(
    fn: Parted, y0: PyTree, args: PyTree, steps: int, memory: int, rtol: float
) -> Solution:
    solver = optx.LBFGS(rtol=rtol, atol=rtol, history_length=memory)
    found = optx.minimise(fn, solver, y0, args, has_aux=True, max_steps=steps, throw=False)
    not_finite, value, aux, still = _ended(fn, y0, found.value, args)
    broken = jnp.any(not_finite[TOTAL])
    # It looks at steps and energies alone, and so takes a failed search for convergence.
    good = (found.result == optx.RESULTS.successful) & ~still
    stuck = still & (found.result != optx.RESULTS.nonlinear_max_steps_reached)
    result = stopped(broken, good, stuck)
    stats = {"num_steps": found.stats["num_steps"], "aux": aux, "not_finite": not_finite}
    return Solution(value, result, stats)


def _ended(
    fn: Parted, y0: PyTree, found: PyTree, args: PyTree
) -> tuple[NotFinite, PyTree, Any, Array]:
    """Flags, answer and ``aux``, and whether it stands where it began on a slope.

    The start is the answer where a run ran into numbers that are not finite.
    """
    lost = holds_no_number(found)
    value = jax.tree.map(lambda new, old: jnp.where(lost, old, new), found, y0)
    at, data = jax.lax.stop_gradient((value, args))
    flat, unravel = ravel_pytree(at)
    energy, aux, gradient = _evaluated(fn, unravel, flat, data)
    not_finite = _terms_at(fn, unravel, _Evaluated(flat, energy, aux, gradient), data)
    moved = jnp.any(flat != ravel_pytree(y0)[0])
    slope = jnp.max(jnp.abs(gradient)) * jnp.max(jnp.abs(flat))
    still = ~moved & (slope > _root_of_precision(flat) * jnp.abs(energy))
    return not_finite, value, aux, still


def _evaluated(
    fn: Parted, unravel: Callable[[Array], PyTree], flat: Array, args: PyTree
) -> tuple[Array, Any, Array]:
    (value, aux), gradient = jax.value_and_grad(lambda y: fn(unravel(y), args), has_aux=True)(flat)
    return value, aux, gradient


class _Evaluated(NamedTuple):
    """The last evaluation of a run on the host."""

    y: Array
    value: Array
    aux: Any
    gradient: Array


def _on_host(
    fn: Parted,
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
    program = jax.jit(jax.value_and_grad(lambda y, args: fn(unravel(y), args), has_aux=True))
    latest: _Evaluated | None = None

    def evaluate(y: Array, args: PyTree) -> tuple[Array, Array]:
        nonlocal latest
        (value, aux), gradient = program(y, args)
        latest = _Evaluated(y, value, aux, gradient)
        return value, gradient

    current = state or lbfgs_start(evaluate, flat, args, memory)
    aux = latest.aux if latest else None
    values = [float(current.value)]
    if not math.isfinite(values[0]):
        words = not_finite_words(_flags_at(current.value, aux, ()))
        raise NotFiniteError(f"the energy at the start is {values[0]}; it must be finite: {words}")
    done, failed, watcher = 0, False, False
    result: Any = optx.RESULTS.nonlinear_max_steps_reached
    seen = _Evaluated(current.y, current.value, aux, current.gradient)
    while done < steps:
        current, lower = lbfgs_step(evaluate, current, args, first_change=first_change)
        if not lower and failed:
            seen = latest or seen
            broken = not math.isfinite(seen.value) or bool(holds_no_number(seen.gradient))
            small = _is_small(current, values, max(rtol, _root_of_precision(flat)), first_change)
            result = stopped(broken, small, True)
            break
        failed = not lower
        if failed:
            continue
        aux = latest.aux if latest else None
        done += 1
        values.append(float(current.value))
        if on_step is not None and on_step(done, current):
            watcher = True
            break
        if len(values) > 10 and values[-11] - values[-1] <= rtol * abs(values[-1]):
            result = optx.RESULTS.successful
            break
    stats = {
        "num_steps": done,
        "aux": aux,
        "not_finite": _terms_at(fn, unravel, seen, args),
        "evaluations": current.evaluations,
        "values": values,
        "state": current,
        "watcher": watcher,
    }
    return Solution(unravel(current.y), result, stats)


def _root_of_precision(x: Array) -> float:
    return float(jnp.finfo(x.dtype).eps) ** 0.5


def _is_small(state: LBFGSState, values: list[float], tolerance: float, least: float) -> bool:
    """Whether the gradient is small beside the energy, or beside what the energy fell by.

    Dennis and Schnabel, "Numerical Methods for Unconstrained Optimization and Nonlinear
    Equations" (1983), section 7.2.
    """
    slope = float(jnp.max(jnp.abs(state.gradient)))
    size = max(float(jnp.max(jnp.abs(state.y))), least)
    return slope * size <= tolerance * max(abs(values[-1]), values[0] - values[-1])


def _terms_at(
    fn: Parted, unravel: Callable[[Array], PyTree], seen: _Evaluated, args: PyTree
) -> NotFinite:
    """Flags, of numbers that are known also of the gradient of each term, if that of all fails."""
    found = _flags_at(seen.value, seen.aux, seen.gradient)
    if isinstance(found[TOTAL], Tracer) or not bool(found[TOTAL][1]):
        return found

    def faulty(name: str) -> Array:
        gradient = jax.grad(lambda y: fn(unravel(y), args)[1][name])(seen.y)
        return flags(False, holds_no_number(gradient))

    return {name: flag if name == TOTAL else flag | faulty(name) for name, flag in found.items()}
