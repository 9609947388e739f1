"""Programs compiled in the background: once, found by whoever runs them, and tried again."""

import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxface._machine import usable_cores
from jaxface.run.clock import Clock, KeptProgram


@pytest.fixture
def counted():
    """A program that waits to be let go while it is traced, what was traced, and the gate."""
    count, gate = Traced(), threading.Event()

    @jax.jit
    def double(x):
        count.add(len(x))
        assert gate.wait(60)
        return 2 * x

    yield double, count, gate
    gate.set()  # a test that failed leaves no thread waiting


class Traced:
    """Lengths of the arguments that a program was traced for, in their order, by any thread."""

    def __init__(self):
        self.lengths = []
        self._changed = threading.Condition()

    def add(self, length):
        with self._changed:
            self.lengths.append(length)
            self._changed.notify_all()

    def wait_for(self, number):
        with self._changed:
            return self._changed.wait_for(lambda: len(self.lengths) >= number, timeout=60)


def test_run_takes_what_was_begun_in_the_background(counted):
    double, count, gate = counted
    clock = Clock()
    clock.begin([(double, (jax.ShapeDtypeStruct((3,), jnp.float32),))])
    assert count.wait_for(1), "it is compiled before anybody runs it"
    gate.set()
    np.testing.assert_array_equal(clock.run("double", double, jnp.ones(3)), 2 * np.ones(3))
    clock.run("double", double, jnp.zeros(3))
    assert count.lengths == [3]
    assert clock.compiling["double"] > 0 and clock.seconds["double"] > 0


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
    monkeypatch.setattr("jaxface.run.clock.usable_cores", lambda: 2)
    shapes = [(jax.ShapeDtypeStruct((n,), jnp.float32),) for n in (6, 5, 4)]
    drop = Clock().begin([(double, shape) for shape in shapes])
    assert count.wait_for(1)
    drop()
    gate.set()
    Clock().run("double", double, jnp.ones(4))
    assert count.lengths == [4], "the last comes first, and no other one is begun"
    Clock().run("double", double, jnp.ones(6))
    assert count.lengths == [4, 6], "what was dropped is compiled by whoever runs it"


@pytest.mark.parametrize(("cores", "at_once"), [(1, 1), (2, 1), (4, 3)])
def test_one_core_is_left_to_the_caller(counted, monkeypatch, cores, at_once):
    double, count, gate = counted
    monkeypatch.setattr("jaxface.run.clock.usable_cores", lambda: cores)
    shapes = [(jax.ShapeDtypeStruct((n,), jnp.float32),) for n in range(10, 14)]
    before = set(threading.enumerate())
    drop = Clock().begin([(double, shape) for shape in shapes])
    assert count.wait_for(at_once)
    assert len(set(threading.enumerate()) - before) == at_once
    drop()
    gate.set()


def test_usable_cores_are_those_that_the_process_may_use(monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 64)
    monkeypatch.setattr("os.sched_getaffinity", lambda process: {0, 5, 7}, raising=False)
    assert usable_cores() == 3
    monkeypatch.delattr("os.sched_getaffinity")
    assert usable_cores() == 64
    monkeypatch.setattr("os.cpu_count", lambda: None)
    assert usable_cores() == 1


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
