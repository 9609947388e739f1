"""Times of a run, with compilation apart."""

import functools
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, NamedTuple, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxface._machine import usable_cores
from jaxface._types import PyTree
from jaxface.run.kept_programs import kept_program

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

    def begin(self, calls: Sequence[tuple[Any, tuple[PyTree, ...]]]) -> Callable[[], None]:
        """Compile programs side by side in the background, for ``run`` to find them.

        XLA compiles one program on one core, and without holding Python's lock. One core is left
        to the caller, and the last programs come first: ``run`` compiles by itself what it needs
        and finds not begun. What it has to wait for counts as compilation.

        Args:
            calls: programs and their arguments, which may be ``jax.ShapeDtypeStruct``s.

        Returns:
            What drops those that are not begun yet.
        """
        pool = ThreadPoolExecutor(max(usable_cores() - 1, 1))
        for program, args in reversed(calls):
            pool.submit(_compiled, program, *args)
        pool.shutdown(wait=False)
        return functools.partial(pool.shutdown, wait=False, cancel_futures=True)

    def host(self, name: str, function: Callable[P, T], *args: P.args, **options: P.kwargs) -> T:
        """Call a function of the host and time it."""
        start = time.perf_counter()
        answer = function(*args, **options)
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
        return answer


_PROGRAMS: dict[Any, Future[Any]] = {}
_LOCK = threading.Lock()


def _compiled(program: Any, *args: PyTree) -> Any:
    """The compiled program for arguments of these shapes, made once a process, by any thread."""
    leaves, structure = jax.tree.flatten(args)
    shapes = tuple((np.shape(x), jnp.result_type(x)) for x in leaves)
    key = (program, structure, shapes)
    with _LOCK:
        found = _PROGRAMS.get(key)
        if found is None:
            ours = _PROGRAMS[key] = Future()
    if found is not None:
        return found.result()
    try:
        ours.set_result(_compile(program, *args))
    except BaseException as error:
        # Whoever waits for it hears of it; the next caller tries again.
        del _PROGRAMS[key]
        ours.set_exception(error)
    return ours.result()


def _compile(program: Any, *args: PyTree) -> Any:
    if not isinstance(program, KeptProgram):
        return program.lower(*args).compile()
    flat = jax.jit(
        kept_program(program.name, program.function, *args),
        compiler_options=program.compiler_options,
    )
    # By shapes alone: where an array lies would be a part of the program, and of its cache's key.
    shapes = [
        jax.ShapeDtypeStruct(x.shape, x.dtype) if isinstance(x, jax.Array) else x
        for x in jax.tree.leaves(args)
    ]
    compiled = flat.lower(*shapes).compile()
    return lambda *args: compiled(*jax.tree.leaves(args))


class KeptProgram(NamedTuple):
    """A function whose traced program is kept between processes (``kept_program``)."""

    name: str
    function: Callable[..., PyTree]
    compiler_options: Any = None

    def __hash__(self) -> int:
        """By name and function: options are a dict."""
        return hash((self.name, self.function))
