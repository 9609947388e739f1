"""Every public function of the numerical layers has derivatives: finite, and right in both modes.

The functions are found by walking the package, so a new one is tested, or asked for, without
anybody remembering. For each, at a random point, with all arguments zero, with all of them equal,
and with each argument zero by itself: derivatives are finite, forward and reverse mode agree, and
both agree with a finite difference wherever the two one-sided differences agree with each other (at
a kink there is no derivative to agree with; at the random point there must be no kink).
"""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests import gradient_cases as cases
from tests import gradient_walk as walk

STEP = 1e-6
"""of a difference, relative to the argument's size"""

FOUND = walk.functions()
LEFT_OUT = {name for names in cases.NOT_DIFFERENTIABLE.values() for name in names}
WALKED = sorted(
    name
    for name, (function, owner) in FOUND.items()
    if name in cases.CASES
    or (not walk.is_host(function) and walk.is_smooth(function, owner) and name not in LEFT_OUT)
)


def case_of(name: str) -> cases.Case:
    """The table's case, or one made from annotations."""
    maker = walk.Maker(0, cases.RECORDS, cases.tables())
    if name in cases.CASES:
        return cases.CASES[name](maker)
    function, owner = FOUND[name]
    try:
        return cases.Case(function, maker.arguments(function, owner))
    except walk.NoCaseError as missing:
        pytest.fail(
            f"{name}: {missing}; give it a case in gradient_cases.CASES, or say in "
            "gradient_cases.NOT_DIFFERENTIABLE why it has no derivative"
        )


@dataclasses.dataclass
class Slopes:
    """One function, compiled: its value and both derivatives along a direction."""

    program: Callable[..., Any]
    names: list[str]
    start: list[Any]

    def along(self, at: list[Any], direction: list[Any], weight: list[Any]) -> Any:
        """Value, forward and reverse derivative (with their sizes) of the weighted outputs."""
        return jax.device_get(self.program(at, direction, weight))


def compiled(case: cases.Case) -> Slopes:
    """A program of a case that takes its floating-point leaves."""
    floating, rest = eqx.partition(case.arguments, eqx.is_inexact_array)
    leaves, structure = jax.tree_util.tree_flatten_with_path(floating)
    names = [jax.tree_util.keystr(path) for path, _ in leaves]

    def outputs(values: list[Any]) -> list[Any]:
        arguments = eqx.combine(jax.tree.unflatten(structure, values), rest)
        given = jax.tree.leaves(case.fn(**arguments))
        return [x for x in given if eqx.is_inexact_array(x)]

    def program(at: list[Any], direction: list[Any], weight: list[Any]) -> Any:
        out, change = jax.jvp(outputs, (at,), (direction,))
        finite = [jnp.where(jnp.isfinite(x), w, 0.0) for x, w in zip(out, weight, strict=True)]
        gradient = jax.vjp(outputs, at)[1](finite)[0]
        masked = [jnp.where(jnp.isfinite(x), x, 0.0) for x in out]

        def dot(a: list[Any], b: list[Any], size: bool) -> Any:
            products = [x * y for x, y in zip(a, b, strict=True)]
            return sum(jnp.sum(jnp.abs(p) if size else p) for p in products)

        return {
            "value": dot(finite, masked, False),
            "size": dot(finite, masked, True),
            "forward": dot(finite, change, False),
            "reverse": dot(gradient, direction, False),
            "slope": dot(finite, change, True) + dot(gradient, direction, True),
            "undefined": jnp.any(jnp.array([jnp.any(jnp.isnan(x)) for x in out])),
        }

    # Compiled with little optimisation: each program runs some hundred times, for microseconds.
    options = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
    values = [jnp.asarray(value, float) for _, value in leaves]
    return Slopes(jax.jit(program, compiler_options=options), names, values)


def weights_of(case: cases.Case, rng: np.random.Generator) -> list[Any]:
    """A random cotangent for the floating-point outputs."""
    floating, rest = eqx.partition(case.arguments, eqx.is_inexact_array)

    def outputs(values: Any) -> list[Any]:
        given = jax.tree.leaves(case.fn(**eqx.combine(values, rest)))
        return [x for x in given if jnp.issubdtype(x.dtype, jnp.floating)]

    shapes = jax.eval_shape(outputs, floating)
    return [jnp.asarray(rng.normal(size=x.shape), x.dtype) for x in shapes]


def points(slopes: Slopes) -> Iterator[tuple[str, list[Any], list[int] | None]]:
    """Where a function is tried, and along which of its arguments (None: each)."""
    start = slopes.start
    yield "a random point", start, None
    yield "all zero", [jnp.zeros_like(x) for x in start], None
    yield "all equal", [jnp.full_like(x, 0.5) for x in start], None
    for index, name in enumerate(slopes.names):
        at = [jnp.zeros_like(x) if i == index else x for i, x in enumerate(start)]
        yield f"{name} zero", at, [index]


@pytest.mark.parametrize("name", WALKED)
def test_derivatives(name: str, x64: None) -> None:
    case = case_of(name)
    rng = np.random.default_rng(1)
    slopes, weight = compiled(case), weights_of(case, rng)
    assert slopes.names and weight, "no floating-point argument or result"
    for where, at, along in points(slopes):
        for index in range(len(at)) if along is None else along:
            held = next(
                (why for h, why in case.held.items() if f"['{h}']" in slopes.names[index]), ""
            )
            singular = case.singular and where != "a random point"
            compare(slopes, at, index, weight, rng, where, bool(held or singular))


def compare(
    slopes: Slopes, at: list[Any], index: int, weight: list[Any], rng: np.random.Generator,
    where: str, held: bool,
) -> None:  # fmt: skip
    """One direction at one point."""
    if not at[index].size:
        return
    scale = float(jnp.sqrt(jnp.mean(slopes.start[index] ** 2))) or 1.0
    move = jnp.asarray(rng.normal(size=at[index].shape)) * scale
    direction = [move if i == index else jnp.zeros_like(x) for i, x in enumerate(at)]
    here = slopes.along(at, direction, weight)
    message = f"at {where}, along {slopes.names[index]}"
    assert not here["undefined"], f"{message}: the value is NaN"
    forward, reverse = float(here["forward"]), float(here["reverse"])
    assert np.isfinite(forward), f"{message}: the forward derivative is {forward}"
    assert np.isfinite(reverse), f"{message}: the reverse derivative is {reverse}"
    assert abs(forward - reverse) <= 1e-8 * here["slope"] + 1e-12, (
        f"{message}: forward {forward}, reverse {reverse}"
    )
    if held:
        return

    def stepped(factor: float) -> Any:
        moved = [x + factor * STEP * d for x, d in zip(at, direction, strict=True)]
        return slopes.along(moved, direction, weight)

    after, before = stepped(1.0), stepped(-1.0)
    noise = 1e-14 * (here["size"] + 1e-3) / STEP
    ahead = (float(after["value"]) - float(here["value"])) / STEP
    behind = (float(here["value"]) - float(before["value"])) / STEP
    allowed = 1e-4 * float(here["slope"]) + 10 * noise
    bent = abs(ahead - behind) > allowed + 1e-4 * (abs(ahead) + abs(behind))
    if bent and where != "a random point":
        return
    difference = (ahead + behind) / 2
    assert abs(forward - difference) <= allowed + 1e-4 * abs(ahead - behind) + 1e-9, (
        f"{message}: derivative {forward}, difference {difference} ({behind} before, {ahead} after)"
    )
