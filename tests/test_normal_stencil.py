"""Normals of linear models: against the plain normals and their forward-mode derivative."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxface.geometry.mesh import vertex_normals
from jaxface.geometry.normal_stencil import normal_derivative, normal_stencil
from tests.small_scene import grid_faces


def _fan(count: int) -> np.ndarray:
    """A disc: vertex 0 with ``count`` neighbours, more than a row of the table holds."""
    rim = np.arange(count) + 1
    return np.stack([np.zeros(count, int), rim, np.roll(rim, -1)], axis=1)


MESHES = {
    "grid": (grid_faces(6), 36),
    "fan of 20": (_fan(20), 21),
    "one triangle": (np.array([[0, 1, 2]]), 3),
    "three triangles on an edge": (np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]), 5),
}


@pytest.mark.parametrize("name", MESHES)
def test_equals_autodiff(x64, name):
    faces, count = MESHES[name]
    rng = np.random.default_rng(0)
    vertices = jnp.asarray(rng.normal(size=(count, 3)) + 3 * np.eye(count, 3))
    basis = jnp.asarray(rng.normal(size=(count, 3, 4)))
    unit, change = normal_derivative(vertices, normal_stencil(faces, count), basis)
    np.testing.assert_allclose(unit, vertex_normals(vertices, jnp.asarray(faces)), atol=1e-12)
    for mode in range(4):
        expected = jax.jvp(
            lambda v: vertex_normals(v, jnp.asarray(faces)), (vertices,), (basis[..., mode],)
        )[1]
        np.testing.assert_allclose(change[..., mode], expected, atol=1e-10)


def test_vertex_without_area_has_zero_normal_and_derivative():
    faces = np.array([[0, 1, 2]])
    vertices = jnp.zeros((4, 3))
    unit, change = normal_derivative(vertices, normal_stencil(faces, 4), jnp.ones((4, 3, 2)))
    assert not np.asarray(unit).any()
    assert not np.asarray(change).any()
