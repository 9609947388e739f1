"""Damped Gauss-Newton on a quadratic model that the problem supplies, as an optimistix minimiser.

Iteratively reweighted least squares (and anything else that is re-chosen between steps, such as
visibility) fits in through ``refresh``: data held fixed within a step. Steps are accepted only if
the true energy falls, so the iteration descends where plain Gauss-Newton would diverge
(Marquardt, "An algorithm for least-squares estimation of nonlinear parameters", 1963). Curvature
need not be positive: the damping grows until the damped matrix has a Cholesky factor, and the step
then descends (Nocedal and Wright, "Numerical Optimization", section 3.4).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jax.flatten_util import ravel_pytree

from jaxface._types import Array, Bool, Float, Int, PyTree
from jaxface.solvers.finiteness import TOTAL, NotFinite, flags, holds_no_number
from jaxface.solvers.problem import Problem
from jaxface.solvers.solution import Solution, stopped

INDEFINITE = 1e9
"""damping, of a curvature of unit diagonal, beyond which no factor is looked for"""


class _State(eqx.Module):
    damping: Array
    step: Array
    done: Array
    result: Any
    history: dict[str, Array]
    curvature: Array
    not_finite: NotFinite


class _Attempt(NamedTuple):
    damping: Array
    """of the next try, or of the next step"""
    used: Array
    """that of this one"""
    trial: Array
    value: Array
    count: Array
    accepted: Array
    parts: dict[str, Array]


class GaussNewton(optx.AbstractMinimiser):
    """Levenberg-Marquardt-damped Gauss-Newton; see ``gauss_newton`` for the plain function.

    Needs ``options={"problem": Problem, "steps": int, "limit": int or array}``. A step that does
    not lower the energy is retried with more damping up to ``tries`` times. Damping that does not
    make the curvature positive is raised without counting as a try. If no try helps, the solve has
    converged to what the arithmetic can resolve, or is stuck: the gradient tells.
    """

    rtol: float = 1e-5
    atol: float = 0.0
    norm: Callable[[PyTree], Array] = optx.max_norm
    damping: float = 1e-3
    tries: int = 6

    def init(
        self,
        fn: Any,
        y: PyTree,
        args: PyTree,
        options: dict[str, Any],
        f_struct: Any,
        aux_struct: Any,
        tags: frozenset[object],
    ) -> _State:
        """Start with the initial damping and an empty history."""
        steps = options["steps"]
        names = [TOTAL, *jax.tree.leaves(options["names"])]
        unused = jnp.full((steps + 1,), jnp.inf, f_struct.dtype)
        none = jnp.asarray(options["limit"] == 0)
        return _State(
            damping=jnp.asarray(self.damping, f_struct.dtype),
            step=jnp.asarray(0),
            done=none,
            result=optx.RESULTS.where(
                none, optx.RESULTS.nonlinear_max_steps_reached, optx.RESULTS.successful
            ),
            history=dict.fromkeys(names, unused),
            curvature=jnp.zeros((ravel_pytree(y)[0].size,) * 2, f_struct.dtype),
            not_finite=dict.fromkeys(names, flags()),
        )

    def step(
        self,
        fn: Any,
        y: PyTree,
        args: PyTree,
        options: dict[str, Any],
        state: _State,
        tags: frozenset[object],
    ) -> tuple[PyTree, _State, Any]:
        """Build the quadratic model once and take the first damped step that descends."""
        problem = options["problem"]
        data = problem.refresh(y, args)
        (value, gradient, curvature, *more), parts = problem.quadratic(y, data)
        flat, unravel = ravel_pytree(y)
        # Data may be wider than the unknowns: the model counts in the precision of the energy.
        wide = state.damping.dtype
        value, gradient, curvature, parts = jax.tree.map(
            lambda x: jnp.asarray(x, wide), (value, gradient, curvature, parts)
        )
        scale = _unit_scale(curvature)
        unit = curvature * scale[:, None] * scale
        whole = [holds_no_number(x) for x in (value, gradient, curvature)]
        broken = jnp.any(jnp.stack(whole)) | holds_no_number(flat)

        def attempt(carry: _Attempt) -> _Attempt:
            matrix = unit + carry.damping * jnp.eye(len(flat), dtype=wide)
            operator = lx.MatrixLinearOperator(matrix, lx.positive_semidefinite_tag)
            rhs = -0.5 * scale * gradient
            found = lx.linear_solve(operator, rhs, solver=lx.Cholesky(), throw=False).value
            trial = (flat + scale * found).astype(flat.dtype)
            usable = jnp.all(jnp.isfinite(trial))
            trial = jnp.where(usable, trial, flat)
            trial_value, trial_parts = jax.tree.map(
                lambda x: jnp.asarray(x, wide), problem.energy(unravel(trial), data)
            )
            better = usable & (trial_value < value) & jnp.isfinite(trial_value)
            next_damping = jnp.where(
                better, carry.damping / 3, jnp.maximum(carry.damping * 8, 1e-6)
            )
            return _Attempt(
                next_damping,
                carry.damping,
                trial,
                trial_value,
                carry.count + usable,
                better,
                trial_parts,
            )

        tried = jax.lax.while_loop(
            lambda c: (c.count < self.tries) & (c.damping < INDEFINITE) & ~c.accepted & ~broken,
            attempt,
            _Attempt(
                state.damping,
                state.damping,
                flat,
                value,
                jnp.asarray(0),
                jnp.asarray(False),
                parts,
            ),
        )
        accepted = tried.accepted
        new = jnp.where(accepted, tried.trial, flat)
        new_value = jnp.where(accepted, tried.value, value)
        # A step that much damping keeps short lowers the energy by little wherever it is taken.
        gained = (value - new_value) * jnp.maximum(tried.used, 1.0)
        settled = gained <= self.rtol * jnp.abs(value) + self.atol
        # What a step along one unknown alone could gain, by the model; and the step itself.
        promise = 0.25 * jnp.max(jnp.square(scale * gradient))
        alone = jnp.abs(0.5 * scale**2 * gradient)
        epsilon = jnp.finfo(flat.dtype).eps
        level = promise <= jnp.maximum(self.rtol, 10 * epsilon) * jnp.abs(value) + self.atol
        resolved = jnp.all(alone <= 100 * epsilon * jnp.abs(flat))
        # A wall of numbers that are not finite is no minimum.
        walled = ~accepted & ~jnp.isfinite(tried.value)
        ended = state.step + 1 >= options["limit"]
        stuck = ~accepted & ~level & ~resolved
        converged = jnp.where(accepted, settled, level | resolved)
        history = {
            name: state.history[name]
            .at[state.step]
            .set(value if name == TOTAL else parts[name])
            .at[state.step + 1]
            .set(
                new_value if name == TOTAL else jnp.where(accepted, tried.parts[name], parts[name])
            )
            for name in state.history
        }
        own = more[0] if more and more[0] is not None else _flags_of(parts)
        not_finite = {
            name: (flags(*whole) if name == TOTAL else own[name])
            | (walled & flags(~jnp.isfinite(tried.value if name == TOTAL else tried.parts[name])))
            for name in state.history
        }
        done = broken | ~accepted | settled | ended
        result = stopped(broken | walled, converged, stuck)
        state = _State(
            damping=jnp.clip(tried.damping, 1e-7, 1e3),
            step=state.step + 1,
            done=done,
            result=optx.RESULTS.where(done, result, optx.RESULTS.successful),
            history=history,
            curvature=curvature,
            not_finite=not_finite,
        )
        return unravel(new), state, parts

    def terminate(
        self,
        fn: Any,
        y: PyTree,
        args: PyTree,
        options: dict[str, Any],
        state: _State,
        tags: frozenset[object],
    ) -> tuple[Array, Any]:
        """Stop at the last step, or when the energy no longer falls; the result says which."""
        return state.done, state.result

    def postprocess(
        self,
        fn: Any,
        y: PyTree,
        aux: Any,
        args: PyTree,
        options: dict[str, Any],
        state: _State,
        tags: frozenset[object],
        result: Any,
    ) -> tuple[PyTree, Any, dict[str, Any]]:
        """Report the energies before each step and after the last."""
        stats = {
            "history": state.history,
            "damping": state.damping,
            "curvature": state.curvature,
            "not_finite": state.not_finite,
        }
        return y, aux, stats


def gauss_newton(
    problem: Problem,
    y0: PyTree,
    args: PyTree = None,
    *,
    steps: int = 30,
    limit: int | Int[Array, ""] | None = None,
    rtol: float = 1e-5,
    damping: float = 1e-3,
    tries: int = 6,
) -> Solution:
    """Minimise ``problem.energy`` by at most ``steps`` damped Gauss-Newton steps.

    The answer never has a larger energy than the start at equal data, and is never NaN unless
    the start is. A curvature that is not positive, as scalar terms can have, is damped until it
    is, so that steps descend there too. The result is ``successful`` where an accepted step lowered
    the energy by less than ``rtol`` of it, or where no step does and the gradient promises no more
    than that or than the arithmetic resolves; `reason` says what else ended the solve, and which
    term was not finite. A saddle point's gradient is zero too: start elsewhere.

    Differentiable with respect to ``args`` (also in forward mode) by the implicit
    function theorem, with the exact Hessian and ``refresh`` held fixed: true where the solve
    converged to a stationary point. jit-able and vmappable.

    In float32 the energy resolves to about 1e-6 of its value, so coefficients are good to about
    the square root of that, 1e-3 of the width of their posterior.

    Args:
        problem: energy, quadratic model and what is refreshed between steps.
        y0: start, a pytree of floating-point arrays.
        args: data, passed on to ``problem.refresh``.
        steps: greatest number of steps, fixed at compile time.
        limit: greatest number of steps of this call, up to ``steps``; may be traced.
        rtol: stop when a step lowers the energy by less than this share of it.
        damping: initial Levenberg-Marquardt factor, relative to the diagonal.
        tries: attempts, with growing damping, before a step is given up.

    Returns:
        ``stats``: ``num_steps``; ``history``, a dict of (steps + 1,) arrays with the total and each
        part's value before every step and after the last, infinite where unused; ``damping``,
        the last factor; ``curvature``, (p, p), that of the last step's quadratic model (zero if
        there was none); ``not_finite``, see `Solution`.
    """
    # Each is traced in several places (shapes, closure conversion, the step): jit traces once.
    problem = Problem(*(jax.jit(part) for part in problem))

    def fn(y, args):
        data = problem.refresh(jax.lax.stop_gradient(y), args)
        return problem.energy(y, data)

    shapes = jax.eval_shape(fn, y0, args)[1]
    solution = optx.minimise(
        fn,
        GaussNewton(rtol=rtol, damping=damping, tries=tries),
        y0,
        args,
        options={
            "problem": problem,
            "steps": steps,
            "limit": steps if limit is None else limit,
            "names": {k: k for k in shapes},
        },
        has_aux=True,
        max_steps=max(steps, 1),
        throw=False,
    )
    return Solution(solution.value, solution.result, solution.stats)


def _unit_scale(curvature: Float[Array, "p p"]) -> Float[Array, " p"]:
    """Jacobi scaling to a unit diagonal, so that one damping serves unknowns of all units.

    No entry of a positive semidefinite matrix then exceeds one. Where one does, the matrix is
    indefinite, and its rows are evened out as well (Ruiz, "A scaling algorithm to equilibrate both
    rows and columns norms in matrices", 2001), so that damping of about the number of unknowns
    makes it positive.
    """
    diagonal = jnp.abs(jnp.diagonal(curvature))
    floor = 1e-12 * jnp.max(jnp.abs(curvature)) + 1e-30
    scale = 1.0 / jnp.sqrt(jnp.maximum(diagonal, floor))
    largest = jnp.max(jnp.abs(curvature) * scale[:, None] * scale, axis=1)
    return scale / jnp.sqrt(jnp.where(largest > 1.001, largest, 1.0))


def _flags_of(parts: dict[str, Array]) -> dict[str, Bool[Array, "3"]]:
    return {name: flags(~jnp.isfinite(part)) for name, part in parts.items()}
