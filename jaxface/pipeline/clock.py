"""Times of a run, with compilation apart."""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, NamedTuple, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import PyTree
from jaxface.pipeline.programs import kept_program

P = ParamSpec("P")
T = TypeVar("T")


@dataclass
class Clock:
    """Seconds of every step, compilation apart."""

    seconds: dict[str, float] = field(default_factory=dict)
    compiling: dict[str, float] = field(default_factory=dict)

    def run(self, name: str, program: Any, *args: PyTree) -> Any:
        """Call a jitted function and wait for it; its compilation is timed on its own."""
        start = time.perf_counter()
        compiled = _compiled(program, *args)
        ready = time.perf_counter()
        answer = jax.block_until_ready(compiled(*args))
        self.compiling[name] = self.compiling.get(name, 0.0) + ready - start
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - ready
        return answer

    def prepare(self, name: str, calls: Sequence[tuple[Any, tuple[PyTree, ...]]]) -> None:
        """Compile programs side by side; arguments may be ``jax.ShapeDtypeStruct``s.

        XLA compiles one program on one core, and without holding Python's lock.
        """
        start = time.perf_counter()
        with ThreadPoolExecutor() as pool:
            list(pool.map(lambda call: _compiled(call[0], *call[1]), calls))
        self.compiling[name] = self.compiling.get(name, 0.0) + time.perf_counter() - start

    def host(self, name: str, function: Callable[P, T], *args: P.args, **options: P.kwargs) -> T:
        """Call a function of the host and time it."""
        start = time.perf_counter()
        answer = function(*args, **options)
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
        return answer


_PROGRAMS: dict[Any, Any] = {}


def _compiled(program: Any, *args: PyTree) -> Any:
    """The compiled program for arguments of these shapes, made once a process."""
    leaves, structure = jax.tree.flatten(args)
    shapes = tuple((np.shape(x), jnp.result_type(x)) for x in leaves)
    key = (program, structure, shapes)
    if key not in _PROGRAMS:
        if isinstance(program, KeptProgram):
            flat = jax.jit(
                kept_program(program.name, program.function, *args),
                compiler_options=program.compiler_options,
            )
            compiled = flat.lower(*leaves).compile()
            _PROGRAMS[key] = lambda *args: compiled(*jax.tree.leaves(args))
        else:
            _PROGRAMS[key] = program.lower(*args).compile()
    return _PROGRAMS[key]


class KeptProgram(NamedTuple):
    """A function whose traced program is kept between processes (``kept_program``)."""

    name: str
    function: Callable[..., PyTree]
    compiler_options: Any = None

    def __hash__(self) -> int:
        """By name and function: options are a dict."""
        return hash((self.name, self.function))
