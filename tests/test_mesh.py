"""Normals and topology of triangle meshes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxface.geometry import mesh

TETRAHEDRON = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
TETRAHEDRON_FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
# Two triangles that share the edge (1, 2), and a vertex that none uses.
STRIP = np.array([[0, 1, 2], [1, 3, 2]])


def grid(n, seed=0):
    """A bumpy open square of 2 (n - 1)^2 triangles."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(n), np.arange(n))
    vertices = np.stack([x, y, 0.3 * rng.normal(size=(n, n))], axis=-1).reshape(-1, 3)
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([b, d, c], -1)]).reshape(-1, 3)
    return vertices, faces


@pytest.mark.parametrize("double", [False, True])
def test_opposite_faces_cancel_whatever_their_first_corner(double):
    with jax.enable_x64(double):
        vertices = jnp.asarray(np.random.default_rng(0).normal(size=(5, 3)) + 3.0)
        faces = jnp.array([[0, 1, 2], [1, 0, 2], [0, 3, 4], [4, 3, 0]])
        direction = jnp.ones_like(vertices)

        def normals(moved):
            return mesh.vertex_normals(moved, faces)

        value, forward = jax.jvp(normals, (vertices,), (direction,))
        reverse = jax.vjp(normals, vertices)[1](jnp.ones_like(value))[0]
        for found in (value, forward, reverse):
            np.testing.assert_array_equal(found, 0.0)
        kept = mesh.vertex_normals(vertices, faces[:1])
        np.testing.assert_allclose(jnp.linalg.norm(kept[:3], axis=1), 1.0, rtol=1e-5)


def test_normals_point_outward_and_are_area_weighted():
    normals = mesh.face_normals(jnp.asarray(TETRAHEDRON), TETRAHEDRON_FACES)
    outward = np.array([[0, 0, -1], [0, -1, 0], [-1, 0, 0], np.ones(3) / np.sqrt(3)])
    np.testing.assert_allclose(normals, outward, atol=1e-6)
    # At the corner of three equal right triangles, and at a vertex beside the large one.
    at_vertices = mesh.vertex_normals(jnp.asarray(TETRAHEDRON), TETRAHEDRON_FACES)
    np.testing.assert_allclose(at_vertices[0], -np.ones(3) / np.sqrt(3), atol=1e-6)
    large, small = np.ones(3), np.array([0.0, -1, -1])
    np.testing.assert_allclose(
        at_vertices[1], (large + small) / np.linalg.norm(large + small), atol=1e-6
    )


def test_the_table_gives_the_same_normals_as_the_scatter():
    vertices, faces = grid(7)
    table = mesh.incident_faces(faces, len(vertices) + 1)
    vertices = jnp.asarray(np.concatenate([vertices, [[9.0, 9.0, 9.0]]]))
    scattered = mesh.vertex_normals(vertices, faces)
    np.testing.assert_allclose(mesh.vertex_normals(vertices, faces, table), scattered, atol=1e-6)
    np.testing.assert_array_equal(scattered[-1], 0.0)
    np.testing.assert_allclose(jnp.linalg.norm(scattered[:-1], axis=1), 1.0, atol=1e-6)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 1000), tabled=st.booleans())
def test_derivatives_of_normals_equal_differences(seed, tabled):
    vertices, faces = grid(4, seed)
    table = jnp.asarray(mesh.incident_faces(faces, len(vertices))) if tabled else None
    with jax.enable_x64(True):
        rng = np.random.default_rng(seed)
        vertices, step = jnp.asarray(vertices), jnp.asarray(rng.normal(size=vertices.shape))
        weights = jnp.asarray(rng.normal(size=vertices.shape))

        def energy(v):
            return jnp.sum(weights * mesh.vertex_normals(v, faces, table))

        difference = (energy(vertices + 1e-6 * step) - energy(vertices - 1e-6 * step)) / 2e-6
        _, forward = jax.jvp(energy, (vertices,), (step,))
        reverse = jnp.sum(jax.grad(energy)(vertices) * step)
        np.testing.assert_allclose(forward, difference, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(reverse, forward, rtol=1e-10, atol=1e-12)


def test_degenerate_triangles_have_no_nan():
    vertices = jnp.zeros((4, 3)).at[1, 0].set(1.0)
    faces = jnp.array([[0, 1, 1], [0, 2, 3], [0, 1, 2]])
    for normals in (mesh.vertex_normals, mesh.face_normals):
        assert float(jnp.abs(normals(vertices, faces)).max()) == 0
        assert bool(jnp.isfinite(jax.grad(lambda v, f=normals: f(v, faces).sum())(vertices)).all())


def test_edges_and_their_triangles():
    np.testing.assert_array_equal(mesh.edges(STRIP), [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]])
    np.testing.assert_array_equal(
        mesh.edge_faces(STRIP), [[0, -1], [0, -1], [0, 1], [1, -1], [1, -1]]
    )
    assert len(mesh.edges(TETRAHEDRON_FACES)) == 6
    with pytest.raises(ValueError, match="shared by 3 triangles"):
        mesh.edge_faces(np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]))
    with pytest.raises(ValueError, match=r"\(f, 3\) is needed"):
        mesh.edges(np.array([[0, 1, 2, 3]]))


def test_boundary():
    np.testing.assert_array_equal(mesh.boundary_edges(STRIP), [[0, 1], [0, 2], [1, 3], [2, 3]])
    assert mesh.boundary_edges(TETRAHEDRON_FACES).shape == (0, 2)
    vertices, faces = grid(5)
    inside = np.zeros((5, 5), bool)
    inside[1:-1, 1:-1] = True
    np.testing.assert_array_equal(mesh.boundary_vertices(faces, len(vertices)), ~inside.reshape(-1))


def test_neighbours_and_incident_triangles():
    np.testing.assert_array_equal(
        mesh.vertex_neighbours(STRIP, 5),
        [[1, 2, -1], [0, 2, 3], [0, 1, 3], [1, 2, -1], [-1, -1, -1]],
    )
    np.testing.assert_array_equal(
        mesh.incident_faces(STRIP, 5), [[0, -1], [0, 1], [0, 1], [1, -1], [-1, -1]]
    )
    empty = np.zeros((0, 3), int)
    assert mesh.edges(empty).shape == (0, 2)
    assert mesh.incident_faces(empty, 3).shape == (3, 0)


def test_smoothing_keeps_a_constant_and_evens_out_the_rest(x64):
    faces = jnp.asarray(grid(9)[1])
    rough = jnp.asarray(np.random.default_rng(0).normal(size=(82, 2)))
    constant = jnp.ones((82, 2))
    np.testing.assert_allclose(mesh.smooth_over_mesh(constant, faces, 3)[:81], 1.0)
    once, often = (mesh.smooth_over_mesh(rough, faces, n)[:81] for n in (1, 8))
    assert jnp.std(often) < 0.6 * jnp.std(once) < 0.6 * jnp.std(rough)
    # A vertex of no triangle has no neighbours to learn from.
    np.testing.assert_array_equal(mesh.smooth_over_mesh(rough, faces, 1)[81], 0.0)
    np.testing.assert_array_equal(mesh.smooth_over_mesh(rough, faces, 0), rough)
