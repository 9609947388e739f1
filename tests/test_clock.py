"""Programs compiled in the background: once, found by whoever runs them, and tried again."""

import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxface.run.clock import Clock, KeptProgram


@pytest.fixture
def counted():
    """A program that waits to be let go while it is traced, how often it was, and the gate."""
    count, gate = [], threading.Event()

    @jax.jit
    def double(x):
        count.append(threading.current_thread())
        assert gate.wait(60)
        return 2 * x

    return double, count, gate


def test_run_takes_what_was_begun_in_the_background(counted):
    double, count, gate = counted
    clock = Clock()
    clock.begin([(double, (jax.ShapeDtypeStruct((3,), jnp.float32),))])
    gate.set()
    np.testing.assert_array_equal(clock.run("double", double, jnp.ones(3)), 2 * np.ones(3))
    clock.run("double", double, jnp.zeros(3))
    assert len(count) == 1
    assert clock.compiling["double"] >= 0 and clock.seconds["double"] > 0


def test_a_failure_is_told_to_whoever_runs_the_program_and_is_not_kept():
    wrong = [True]

    @jax.jit
    def program(x):
        if wrong:
            raise ValueError("not today")
        return x + 1

    clock = Clock()
    clock.begin([(program, (jnp.ones(2),))])
    with pytest.raises(ValueError, match="not today"):
        clock.run("program", program, jnp.ones(2))
    wrong.clear()
    np.testing.assert_array_equal(clock.run("program", program, jnp.ones(2)), [2, 2])


def test_what_is_not_begun_can_be_dropped(counted, monkeypatch):
    double, count, gate = counted
    monkeypatch.setattr("os.cpu_count", lambda: 1)
    shapes = [(jax.ShapeDtypeStruct((n,), jnp.float32),) for n in (6, 5, 4)]
    drop = Clock().begin([(double, shape) for shape in shapes])
    while not count:
        pass
    drop()
    gate.set()
    Clock().run("double", double, jnp.ones(4))
    assert len(count) == 1


def test_a_kept_program_does_not_depend_on_where_its_arguments_lie(monkeypatch):
    seen = []

    class Jitted:
        def lower(self, *leaves):
            seen.append(leaves)
            return self

        def compile(self):
            return lambda *leaves: leaves

    monkeypatch.setattr("jaxface.run.clock.kept_program", lambda name, function, *args: None)
    monkeypatch.setattr("jaxface.run.clock.jax.jit", lambda function, **how: Jitted())
    program = KeptProgram("anything", lambda x, y: x)
    assert Clock().run("anything", program, jnp.ones(3), 2.0)[1] == 2.0
    assert seen == [(jax.ShapeDtypeStruct((3,), jnp.float32), 2.0)]
