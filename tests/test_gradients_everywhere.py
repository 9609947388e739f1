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
from tests import gradient_inputs as inputs
from tests import gradient_walk as walk

STEP = 1e-6
"""of a difference, relative to the argument's size"""

QUARTER = (STEP / 4, -STEP / 4)

PLAIN = 6
"""arguments, at most, of a function that is tried with all of them equal"""

RANDOM = "a random point"

REPORTED = ("value", "size", "forward", "reverse", "slope", "undefined")

Flat = np.ndarray

FOUND = walk.functions()
LEFT_OUT = {name for names in cases.NOT_DIFFERENTIABLE.values() for name in names}
WALKED = sorted(
    name
    for name, (function, owner) in FOUND.items()
    if name in cases.CASES
    or (not walk.is_host(function) and walk.is_smooth(function, owner) and name not in LEFT_OUT)
)
WEIGHTS = sorted(
    name
    for module in walk.modules()
    for name, value in vars(module).items()
    if name.endswith("Weights") and walk.is_record(value) and value.__module__ == module.__name__
)


def test_nothing_is_left_out_that_is_not_there() -> None:
    unknown = (LEFT_OUT | set(cases.CASES) | cases.SLOW) - set(FOUND)
    assert not unknown, f"the table names functions that do not exist: {sorted(unknown)}"
    both = LEFT_OUT & set(cases.CASES)
    assert not both, f"both a case and left out: {sorted(both)}"


def test_the_walk_finds_functions_of_every_kind() -> None:
    for name in (
        "_numerics.safe_norm", "geometry.camera.Camera.project", "imaging.colour.luminance",
        "render.shading.irradiance", "energies.prior.prior_residual", "stages._unwrap.unwrap",
    ):  # fmt: skip
        assert name in WALKED
    for name in ("geometry.mesh.edges", "imaging.masks.dilate", "stages.fit.contour.slide_contour"):
        assert name in FOUND and name not in WALKED


@pytest.mark.parametrize("name", WEIGHTS)
def test_every_field_of_a_record_of_weights_is_walked(name: str, x64: None) -> None:
    assert name in cases.WEIGHTS, f"say in gradient_cases.WEIGHTS which case walks {name}"
    walked = case_of(cases.WEIGHTS[name])
    records = [
        x
        for x in jax.tree.leaves(walked.arguments, is_leaf=lambda x: type(x).__name__ == name)
        if type(x).__name__ == name
    ]
    fields = [getattr(records[0], field.name) for field in dataclasses.fields(records[0])]
    assert fields and all(jax.tree.leaves(field) for field in fields)
    assert all(eqx.is_inexact_array(x) for x in jax.tree.leaves(fields))


def case_of(name: str) -> cases.Case:
    """The table's case, or one made from annotations."""
    maker = walk.Maker(0, inputs.RECORDS, inputs.tables())
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

    program: Callable[[Flat, Flat], Any]
    names: list[str]
    places: list[slice]
    """of each argument in the flattened ones"""
    start: Flat

    def along(self, at: Flat, direction: Flat) -> dict[str, float]:
        """Value, forward and reverse derivative (with their sizes) of the weighted outputs."""
        values = np.asarray(self.program(at, direction))
        return dict(zip(REPORTED, values.tolist(), strict=True))


def compiled(case: cases.Case, rng: np.random.Generator) -> Slopes:
    """A program of a case that takes its floating-point leaves as one vector."""
    floating, rest = eqx.partition(case.arguments, eqx.is_inexact_array)
    leaves, structure = jax.tree_util.tree_flatten_with_path(floating)
    names = [jax.tree_util.keystr(path) for path, _ in leaves]
    shapes = [np.shape(value) for _, value in leaves]
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes]).tolist()
    places = [slice(a, b) for a, b in zip([0, *ends[:-1]], ends, strict=True)]

    def outputs(flat: Any) -> list[Any]:
        values = [flat[p].reshape(s) for p, s in zip(places, shapes, strict=True)]
        arguments = eqx.combine(jax.tree.unflatten(structure, values), rest)
        given = jax.tree.leaves(case.fn(**arguments))
        return [x for x in given if eqx.is_inexact_array(x)]

    def program(at: Any, direction: Any) -> Any:
        out, push = jax.linearize(outputs, at)
        change = push(direction)
        weight = [jnp.asarray(rng.normal(size=x.shape), x.dtype) for x in out]
        finite = [jnp.where(jnp.isfinite(x), w, 0.0) for x, w in zip(out, weight, strict=True)]
        gradient = jax.linear_transpose(push, at)(finite)[0]
        masked = [jnp.where(jnp.isfinite(x), x, 0.0) for x in out]

        def dot(a: list[Any], b: list[Any], size: bool) -> Any:
            products = [jnp.ravel(x * y) for x, y in zip(a, b, strict=True)]
            joined = jnp.concatenate(products)
            return jnp.sum(jnp.abs(joined) if size else joined)

        return jnp.stack([
            dot(finite, masked, False), dot(finite, masked, True),
            dot(finite, change, False), dot([gradient], [direction], False),
            dot(finite, change, True) + dot([gradient], [direction], True),
            jnp.any(jnp.isnan(jnp.concatenate([jnp.ravel(x) for x in out]))).astype(float),
        ])  # fmt: skip

    flat = [np.ravel(np.asarray(value, float)) for _, value in leaves]
    start = np.concatenate([np.zeros(0), *flat])
    # Compiled with little optimisation: each program runs some hundred times, for microseconds.
    options = {
        "xla_backend_optimization_level": 0,
        "xla_llvm_disable_expensive_passes": True,
        "xla_cpu_use_fusion_emitters": False,
    }
    return Slopes(jax.jit(program, compiler_options=options), names, places, start)


def points(slopes: Slopes) -> Iterator[tuple[str, Flat, list[int]]]:
    """Where a function is tried, and along which of its arguments."""
    start, each = slopes.start, list(range(len(slopes.names)))
    yield RANDOM, start, each
    free = [i for i in each if not any(word in slopes.names[i] for word in cases.POSITIVE)]
    zero, equal = start.copy(), start.copy()
    for index in free:
        at, place = start.copy(), slopes.places[index]
        at[place], zero[place], equal[place] = 0.0, 0.0, 0.5
        yield f"{slopes.names[index]} zero", at, [index]
    yield "all zero", zero, free
    # In a scene no more than rounding would be left of the coinciding vertices' differences.
    if len(each) <= PLAIN:
        yield "all equal", equal, free


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.slow) if n in cases.SLOW else n for n in WALKED],
)
def test_derivatives(name: str, x64: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jaxface.render._rasterize._nearest", cases.nearest)
    case = case_of(name)
    rng = np.random.default_rng(1)
    slopes = compiled(case, np.random.default_rng(2))
    assert slopes.names, "no floating-point argument"
    for where, at, along in points(slopes):
        for index in along:
            held = any(f"['{name}']" in slopes.names[index] for name in case.held)
            held = held or bool(case.singular and where != RANDOM)
            compare(slopes, at, index, rng, where, held)


def compare(
    slopes: Slopes, at: Flat, index: int, rng: np.random.Generator, where: str, held: bool
) -> None:
    """One direction at one point."""
    place = slopes.places[index]
    if place.start == place.stop:
        return
    size = slopes.start[place]
    direction = np.zeros_like(at)
    direction[place] = rng.normal(size=size.shape) * (float(np.sqrt(np.mean(size**2))) or 1.0)
    here = slopes.along(at, direction)
    message = f"at {where}, along {slopes.names[index]}"
    assert not here["undefined"], f"{message}: the value is NaN"
    forward, reverse = here["forward"], here["reverse"]
    assert np.isfinite(forward), f"{message}: the forward derivative is {forward}"
    assert np.isfinite(reverse), f"{message}: the reverse derivative is {reverse}"
    assert abs(forward - reverse) <= 1e-8 * here["slope"] + 1e-12, (
        f"{message}: forward {forward}, reverse {reverse}"
    )
    if held:
        return
    after, before = (slopes.along(at + s * direction, direction) for s in (STEP, -STEP))
    noise = 1e-14 * (here["size"] + 1e-3) / STEP
    ahead = (after["value"] - here["value"]) / STEP
    behind = (here["value"] - before["value"]) / STEP
    allowed = 1e-4 * here["slope"] + 10 * noise
    difference = (ahead + behind) / 2
    if where != RANDOM:
        nearer = [slopes.along(at + s * direction, direction)["value"] for s in QUARTER]
        other = (nearer[0] - nearer[1]) / (QUARTER[0] - QUARTER[1])
        slack = allowed + 4 * noise + 1e-4 * (abs(ahead) + abs(behind))
        if max(abs(ahead - behind), abs(difference - other)) > slack:
            return  # a kink, a jump, or too steep to tell
    assert abs(forward - difference) <= allowed + 1e-4 * abs(ahead - behind) + 1e-9, (
        f"{message}: derivative {forward}, difference {difference} ({behind} to {ahead})"
    )
