"""Rotation, camera, closed-form pose and alignment."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial.transform
from hypothesis import given
from hypothesis import strategies as st

from jaxface.geometry.camera import Camera, Pose
from jaxface.geometry.nearest_rotation import nearest_rotation
from jaxface.geometry.pose import pose_from_landmarks
from jaxface.geometry.ray import pixel_rays, ray_weights
from jaxface.geometry.rotation import (
    axis_angle,
    euler_yxz,
    rotation_matrix,
    similarity_transform,
)

many_sweeps = jax.jit(partial(pose_from_landmarks, sweeps=20))
few_sweeps = jax.jit(pose_from_landmarks)

ANGLES = st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3)


@given(ANGLES)
def test_rotation_matches_scipy(vector):
    with jax.enable_x64(True):
        ours = rotation_matrix(jnp.array(vector))
    expected = scipy.spatial.transform.Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(ours, expected, atol=1e-12)


@given(ANGLES)
def test_axis_angle_inverts(vector):
    with jax.enable_x64(True):
        matrix = rotation_matrix(jnp.array(vector))
        again = rotation_matrix(axis_angle(matrix))
    np.testing.assert_allclose(again, matrix, atol=1e-9)


forward_jacobian = jax.jit(jax.jacfwd(rotation_matrix))
reverse_jacobian = jax.jit(jax.jacrev(rotation_matrix))


@pytest.mark.parametrize("scale", [0.0, 1e-8, 1e-3, 0.0316, 1.0, np.pi])
def test_rotation_derivative_in_both_modes(x64, scale):
    vector = scale * jnp.array([0.6, -0.64, 0.48])
    forward, reverse = forward_jacobian(vector), reverse_jacobian(vector)
    np.testing.assert_allclose(forward, reverse, atol=1e-12)
    step = 1e-6
    for axis, e in enumerate(jnp.eye(3)):
        central = (rotation_matrix(vector + step * e) - rotation_matrix(vector - step * e)) / (
            2 * step
        )
        np.testing.assert_allclose(forward[..., axis], central, atol=1e-8)


def test_half_turns(x64):
    for axis in np.eye(3):
        matrix = 2 * np.outer(axis, axis) - np.eye(3)
        vector = axis_angle(jnp.asarray(matrix))
        assert float(jnp.linalg.norm(vector)) == pytest.approx(np.pi)
        np.testing.assert_allclose(rotation_matrix(vector), matrix, atol=1e-9)


def test_euler_angles_rebuild_the_rotation(x64):
    rotation = scipy.spatial.transform.Rotation.from_euler("YXZ", [0.4, -0.3, 0.2])
    angles = euler_yxz(jnp.asarray(rotation.as_matrix()))
    np.testing.assert_allclose(angles, [0.4, -0.3, 0.2], atol=1e-10)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_euler_angles_at_the_pole(sign, x64):
    # Exactly at the pole, and a thousandth of a degree from it, where a sine has lost its digits.
    pole = jnp.array([[0.0, sign, 0.0], [0.0, 0.0, -sign], [-1.0, 0.0, 0.0]])
    angles = euler_yxz(pole)
    np.testing.assert_allclose(angles, [0.0, sign * np.pi / 2, 0.0], atol=1e-15)
    forward, reverse = jax.jacfwd(euler_yxz)(pole), jax.jacrev(euler_yxz)(pole)
    assert np.isfinite(forward).all()
    np.testing.assert_allclose(forward, reverse, atol=1e-12)
    near = [0.4, sign * (np.pi / 2 - 2e-5), 0.2]
    matrix = scipy.spatial.transform.Rotation.from_euler("YXZ", near).as_matrix()
    np.testing.assert_allclose(euler_yxz(jnp.asarray(matrix)), near, atol=1e-9)
    single = euler_yxz(jnp.asarray(matrix, jnp.float32))
    np.testing.assert_allclose(single[1], near[1], atol=1e-7)


def test_nearest_rotation_has_derivatives_where_singular_values_are_equal(x64):
    matrix = 2.0 * rotation_matrix(jnp.array([0.3, -0.2, 0.5]))
    change = jnp.asarray(np.random.default_rng(1).normal(size=(3, 3)))
    found, moved = jax.jvp(nearest_rotation, (matrix,), (change,))
    np.testing.assert_allclose(found, matrix / 2, atol=1e-12)
    ahead, behind = (nearest_rotation(matrix + s * change) for s in (1e-6, -1e-6))
    np.testing.assert_allclose(moved, (ahead - behind) / 2e-6, atol=1e-8)
    mirrored = nearest_rotation(jnp.diag(jnp.array([3.0, 2.0, -1.0])))
    np.testing.assert_allclose(mirrored, np.eye(3), atol=1e-12)


def test_projection_by_hand():
    camera = Camera(jnp.asarray(500.0), jnp.array([320.0, 240.0]))
    seen = camera.project(jnp.array([[10.0, 20.0, -1000.0], [0.0, 0.0, 5.0]]))
    np.testing.assert_allclose(seen[0], [325.0, 230.0, 1000.0], rtol=1e-6)
    assert float(seen[1, 2]) <= 0
    assert np.isfinite(seen).all()


def test_ray_weights_hit_the_projected_point(x64):
    camera = Camera(jnp.asarray(1.5), jnp.array([0.5, 0.4]))
    rng = np.random.default_rng(0)
    corners = jnp.asarray(rng.normal(size=(20, 3, 3)) * 30 + np.array([0, 0, -700.0]))
    weights = jnp.asarray(rng.dirichlet(np.ones(3), 20))
    point = jnp.einsum("pi,pij->pj", weights, corners)
    rays = pixel_rays(camera.project(point)[:, :2], camera.focal, camera.principal)
    np.testing.assert_allclose(ray_weights(rays, corners), weights, atol=1e-8)


def test_edge_on_triangle_is_finite(x64):
    corners = jnp.array([[[0.0, 0, -10], [0, 0, -20], [0, 0, -30]]])

    def total(c):
        return jnp.sum(ray_weights(jnp.array([[0.1, 0.0, -1.0]]), c) ** 2)

    assert float(total(corners)) == 1.0
    assert not np.asarray(jax.jit(jax.grad(total))(corners)).any()


@given(st.floats(-0.7, 0.7), st.floats(-0.4, 0.4), st.floats(-3.0, 3.0), st.floats(400, 2000))
def test_pose_from_landmarks_recovers_a_perspective_pose(yaw, pitch, roll, distance):
    points = np.random.default_rng(7).normal(size=(30, 3)) * [50, 60, 30]
    turn = scipy.spatial.transform.Rotation.from_euler("YXZ", [yaw, pitch, roll])
    with jax.enable_x64(True):
        pose = Pose(jnp.asarray(turn.as_rotvec()), jnp.array([20.0, -30.0, -distance]))
        camera = Camera(jnp.asarray(2.0), jnp.array([0.45, 0.55]))
        target = camera.project(pose(jnp.asarray(points)))[:, :2]
        rotation, translation = many_sweeps(
            jnp.asarray(points), target, jnp.ones(30), camera.focal, camera.principal
        )
        again = camera.project(Pose(rotation, translation)(jnp.asarray(points)))[:, :2]
        few = few_sweeps(jnp.asarray(points), target, jnp.ones(30), camera.focal, camera.principal)
    np.testing.assert_allclose(again, target, atol=2e-4)
    turned = scipy.spatial.transform.Rotation.from_rotvec(np.array(few[0]))
    assert np.degrees((turned * turn.inv()).magnitude()) < 8


@given(st.integers(0, 1000))
def test_similarity_transform_recovers(seed):
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(12, 3))
    turn = scipy.spatial.transform.Rotation.random(rng=seed).as_matrix()
    target = 1.7 * source @ turn.T + [1.0, 2.0, 3.0]
    with jax.enable_x64(True):
        scale, rotation, shift = similarity_transform(jnp.asarray(source), jnp.asarray(target))
    assert float(scale) == pytest.approx(1.7)
    np.testing.assert_allclose(rotation, turn, atol=1e-9)
    np.testing.assert_allclose(shift, [1.0, 2.0, 3.0], atol=1e-9)
