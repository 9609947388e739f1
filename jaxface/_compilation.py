"""Programs that compile quickly."""

import functools
from collections.abc import Callable
from typing import Any

import jax


def quick_jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """``jax.jit`` with ``quick_compilation``, for programs that are called from the host.

    The back end is asked for its options at the first call, not where the program is defined.
    """

    @functools.cache
    def program() -> Callable[..., Any]:
        return jax.jit(function, compiler_options=quick_compilation())

    @functools.wraps(function)
    def call(*args: Any, **given: Any) -> Any:
        return program()(*args, **given)

    return call


@functools.cache
def _accepted(options: tuple[tuple[str, Any], ...]) -> tuple[tuple[str, Any], ...]:
    """The options, or none where the back end is not a CPU's or knows one of them not."""
    if jax.default_backend() != "cpu":
        return ()
    try:
        jax.jit(lambda x: x + 1, compiler_options=dict(options)).lower(0.0).compile()
    except Exception:  # an unknown option raises a different error in every release
        return ()
    return options


_QUICK = (("xla_cpu_use_fusion_emitters", False),)
_QUICKEST = (*_QUICK, ("xla_backend_optimization_level", 0))


def quick_compilation() -> dict[str, Any]:
    """Compiler options that make programs compile faster at the same speed.

    XLA's newer loop emitters for CPUs take twice as long to compile the fit (17 against 9 s of
    processor time a level), half as long again for the networks that find faces (8.8 against
    6.0 s), and gain nothing there. Empty where the option does not exist.
    """
    return dict(_accepted(_QUICK))


def quickest_compilation() -> dict[str, Any]:
    """Compiler options for programs that take next to no time themselves.

    Machine code that LLVM does not optimise takes a third to a half of the time to compile, and up
    to five times as long to run. Empty where an option does not exist.
    """
    return dict(_accepted(_QUICKEST))
