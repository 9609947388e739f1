"""Self-occlusion: what a mesh keeps from itself of the light, and the rotation of harmonics."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxface.geometry.mesh import vertex_normals
from jaxface.geometry.rotation import rotation_matrix
from jaxface.models.subdivide import subdivide
from jaxface.render.occlusion import (
    hidden_shading,
    self_occlusion,
    sh_rotation,
    sphere_lattice,
)
from jaxface.render.shading import ambient_light, sh_basis
from tests.small_scene import small_model


@pytest.fixture(scope="module")
def ball():
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=50.0)
    return jnp.asarray(mesh.vertices, jnp.float32), jnp.asarray(mesh.faces, jnp.int32)


def test_a_convex_surface_hides_nothing_of_its_light(ball):
    np.testing.assert_allclose(self_occlusion(*ball), 0.0, atol=1e-6)


def test_inside_a_closed_ball_no_light_is_left(ball):
    vertices, faces = ball
    inward = faces[:, ::-1]
    normals = vertex_normals(vertices, inward)
    left = sh_basis(normals) + self_occlusion(vertices, inward, directions=512, size=96)
    # What is left is the error of the sum over directions.
    np.testing.assert_allclose(left, 0.0, atol=0.05)


def test_a_wall_over_half_the_sky_takes_half_the_light():
    ground = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
    wall = np.array([[2, -80, -80], [2, 80, -80], [2, 80, 80], [2, -80, 80]], float)
    vertices = jnp.asarray(np.concatenate([ground, wall]), jnp.float32)
    faces = jnp.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], jnp.int32)
    shadow = self_occlusion(vertices, faces, directions=256, size=512, offset=0.3)
    shading = (sh_basis(jnp.array([0.0, 0.0, 1.0])) + shadow[:4]) @ ambient_light(1.0)
    np.testing.assert_allclose(shading, 0.5, atol=0.03)


def test_harmonics_turn_by_a_matrix():
    @settings(deadline=None, max_examples=25)
    @given(st.lists(st.floats(-3, 3), min_size=3, max_size=3))
    def check(axis):
        rotation = rotation_matrix(jnp.array(axis, jnp.float32))
        points = jnp.asarray(sphere_lattice(40), jnp.float32)
        turned = sh_basis(points @ rotation.T)
        np.testing.assert_allclose(sh_basis(points) @ sh_rotation(rotation).T, turned, atol=3e-6)

    check()


def test_rotation_of_the_light_is_differentiable_at_rest():
    light = jnp.asarray(np.random.default_rng(0).normal(size=(9, 3)))
    shadow = jnp.asarray(np.random.default_rng(1).normal(size=(4, 9)))

    def shading(axis):
        return hidden_shading(shadow, rotation_matrix(axis), light)

    with jax.enable_x64(True):
        light, shadow = (jnp.asarray(np.asarray(x), jnp.float64) for x in (light, shadow))
        at = jnp.zeros(3)
        forward, reverse = jax.jacfwd(shading)(at), jax.jacrev(shading)(at)
        step = 1e-5 * jnp.eye(3)
        numeric = jnp.stack([(shading(e) - shading(-e)) / 2e-5 for e in step], axis=-1)
    np.testing.assert_allclose(forward, numeric, atol=1e-8)
    np.testing.assert_allclose(forward, reverse, atol=1e-12)


def test_no_gradient_and_no_nan_from_a_degenerate_triangle(ball):
    vertices, faces = ball
    broken = jnp.concatenate([faces, faces[:1] * 0 + faces[0, 0]])
    assert np.isfinite(np.asarray(self_occlusion(vertices, broken, directions=16))).all()
    gradient = jax.grad(lambda v: jnp.sum(self_occlusion(v, faces, directions=4)))(vertices)
    np.testing.assert_array_equal(gradient, 0.0)


def test_a_finer_model_keeps_its_shadows(x64):
    model = small_model()
    normal = vertex_normals(model.mean, model.faces)
    shadow = 0.1 * sh_basis(normal)
    slope = normal[:, :, None] * shadow[:, None, :]
    finer = subdivide(dataclasses.replace(model, occlusion=shadow, occlusion_slope=slope))
    assert finer.occlusion is not None and finer.occlusion_slope is not None
    rows = subdivide(dataclasses.replace(model, occlusion=slope[:, 1])).occlusion
    assert rows is not None
    np.testing.assert_allclose(finer.occlusion_slope[:, 1], rows, atol=1e-12)
    assert finer.occlusion.shape == (finer.vertex_count, 9)
    light = ambient_light(1.0)
    np.testing.assert_allclose(finer.occlusion @ light, 0.1, rtol=1e-5)
