"""Traced programs on disk: used again, traced anew where they must be, never in the way."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxface._types import Array, Float
from jaxface.run.kept_programs import keep_structure, kept_program


class Pair(eqx.Module):
    """Two arrays."""

    first: Float[Array, "n"]
    second: Float[Array, "n"]


@pytest.fixture
def folder(tmp_path):
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)


@pytest.fixture
def traced():
    """A program that counts how often it is traced, and the count."""
    count = []
    keep_structure(Pair(jnp.zeros(2), jnp.zeros(2)))

    @jax.jit
    def swap(pair, scale):
        count.append(1)
        return Pair(scale * pair.second, pair.first)

    return swap, count


PAIR = Pair(jnp.arange(3.0), jnp.ones(3))


def call(program):
    return jax.jit(kept_program("swap", program, PAIR, 2.0))(*jax.tree.leaves((PAIR, 2.0)))


def test_a_kept_program_is_not_traced_again(folder, traced):
    swap, count = traced
    first = call(swap)
    assert [path.name[:12] for path in folder.glob("traced-*")] == ["traced-swap-"]
    jax.clear_caches()
    count.clear()
    second = call(swap)
    assert not count
    for answer in (first, second):
        assert isinstance(answer, Pair)
        np.testing.assert_array_equal(answer.first, 2.0)
        np.testing.assert_array_equal(answer.second, PAIR.first)


def test_other_shapes_are_another_program(folder, traced):
    call(traced[0])
    longer = Pair(jnp.arange(4.0), jnp.ones(4))
    answer = kept_program("swap", traced[0], longer, 2.0)(*jax.tree.leaves((longer, 2.0)))
    assert answer.first.shape == (4,)
    assert len(list(folder.glob("traced-*"))) == 2


@pytest.mark.parametrize("damage", [b"", b"no zlib", None])
def test_a_damaged_file_is_traced_anew_and_replaced(folder, traced, damage):
    call(traced[0])
    (path,) = folder.glob("traced-*")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2] if damage is None else damage)
    np.testing.assert_array_equal(call(traced[0]).first, 2.0)
    traced[1].clear()
    jax.clear_caches()
    call(traced[0])
    assert not traced[1]


def test_without_a_cache_nothing_is_written(tmp_path, traced, monkeypatch):
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", None)
    try:
        np.testing.assert_array_equal(call(traced[0]).first, 2.0)
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


def test_a_function_of_the_callers_among_the_settings_is_never_kept(folder, traced):
    class Setting(eqx.Module):
        function: object = eqx.field(static=True)

    setting = Setting(lambda x: x + 1)
    program = jax.jit(lambda s, x: s.function(x))
    assert float(kept_program("call", program, setting, 1.0)(1.0)) == 2.0
    assert not list(folder.glob("traced-*"))


def test_a_leaf_has_no_structure_to_keep():
    with pytest.raises(ValueError, match="leaf"):
        keep_structure(jnp.zeros(3))
