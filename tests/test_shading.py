"""Spherical-harmonics shading: the basis, the cosine lobe, and the picture it makes."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.test_util import check_grads

from jaxface.geometry.camera import Camera, Pose
from jaxface.geometry.rotation import rotation_matrix
from jaxface.render.image import render
from jaxface.render.shading import (
    ambient_light,
    irradiance,
    irradiance_slope,
    light_from_radiance,
    sh_basis,
    sh_basis_on_host,
)


def quadrature(bands=16):
    """Directions and weights that integrate polynomials on the sphere exactly."""
    z, weight = np.polynomial.legendre.leggauss(bands)
    angle = 2 * np.pi * (np.arange(2 * bands) + 0.5) / (2 * bands)
    z, angle = np.meshgrid(z, angle, indexing="ij")
    radius = np.sqrt(1 - z * z)
    directions = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1)
    weights = np.broadcast_to(weight[:, None] * np.pi / bands, z.shape)
    return directions.reshape(-1, 3), weights.reshape(-1)


def test_basis_is_orthonormal_and_ordered():
    with jax.enable_x64(True):
        directions, weights = quadrature()
        basis = np.asarray(sh_basis(jnp.asarray(directions)))
        np.testing.assert_allclose((basis * weights[:, None]).T @ basis, np.eye(9), atol=1e-12)
        # The constants of Ramamoorthi & Hanrahan 2001, equation 3, at an unsymmetric normal.
        x, y, z = n = np.array([0.48, -0.6, 0.64])
        expected = [
            0.282095,
            0.488603 * y,
            0.488603 * z,
            0.488603 * x,
            1.092548 * x * y,
            1.092548 * y * z,
            0.315392 * (3 * z * z - 1),
            1.092548 * x * z,
            0.546274 * (x * x - y * y),
        ]
        np.testing.assert_allclose(sh_basis(jnp.asarray(n)), expected, atol=1e-6)


def test_basis_on_the_host_is_the_same(x64):
    normals = np.random.default_rng(3).normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_allclose(
        sh_basis_on_host(normals), sh_basis(jnp.asarray(normals)), atol=1e-14
    )


def test_radiance_becomes_the_clamped_cosine_integral():
    with jax.enable_x64(True):
        directions, weights = quadrature(bands=200)
        radiance = np.random.default_rng(0).normal(size=(9, 3))
        arriving = np.asarray(sh_basis(jnp.asarray(directions))) @ radiance
        normal = np.array([0.6, 0.0, 0.8])
        cosine = np.maximum(directions @ normal, 0.0)
        expected = (weights * cosine) @ arriving / np.pi
        got = irradiance(jnp.asarray(normal), light_from_radiance(jnp.asarray(radiance)))
        np.testing.assert_allclose(got, expected, atol=1e-4)


def test_ambient_light_shades_every_normal_alike():
    normals = jnp.asarray(quadrature(4)[0], jnp.float32)
    np.testing.assert_allclose(irradiance(normals, ambient_light(0.7)), 0.7, rtol=1e-6)
    normals = normals.reshape(4, 8, 3)
    assert irradiance(normals, ambient_light()).shape == (4, 8, 3)


def test_light_stays_with_the_camera_when_the_head_turns():
    # A flat square that shows its front whole: its colour is H(R n) L, uniform.
    corners = jnp.array([[-200.0, -200, 0], [200, -200, 0], [200, 200, 0], [-200, 200, 0]])
    faces = jnp.array([[0, 1, 2], [0, 2, 3]])
    camera = Camera.from_field_of_view(20.0, 40, 40)
    light = jnp.asarray(np.random.default_rng(1).normal(size=(9, 3)), jnp.float32)
    albedo = jnp.full((4, 3), jnp.array([0.2, 0.5, 0.8]))

    @jax.jit
    def draw(rotation, background):
        pose = Pose(rotation, jnp.array([0.0, 0.0, -500.0]))
        return render(corners, albedo, faces, pose, camera, light, 40, 40, background)

    for rotation in ([0.0, 0, 0], [0.0, 0.5, 0], [0.4, -0.3, 0.2]):
        rotation = jnp.array(rotation)
        image = draw(rotation, jnp.zeros(3))
        assert bool(image.mask.all())
        normal = rotation_matrix(rotation) @ jnp.array([0.0, 0.0, 1.0])
        np.testing.assert_allclose(image.normals, jnp.broadcast_to(normal, (40, 40, 3)), atol=1e-5)
        expected = albedo[0] * irradiance(normal, light)
        np.testing.assert_allclose(
            image.color, jnp.broadcast_to(expected, (40, 40, 3)), atol=1e-5, rtol=1e-4
        )


def test_background_shows_where_the_mesh_does_not():
    corners = jnp.array([[-20.0, -20, 0], [20, -20, 0], [0, 20, 0]])
    photo = jnp.asarray(np.random.default_rng(2).uniform(size=(30, 40, 3)), jnp.float32)
    image = render(
        corners,
        jnp.ones((3, 3)),
        jnp.array([[0, 1, 2]]),
        Pose(jnp.zeros(3), jnp.array([0.0, 0.0, -300.0])),
        Camera.from_field_of_view(30.0, 30, 40),
        ambient_light(),
        30,
        40,
        background=photo,
    )
    assert 0 < int(image.mask.sum()) < 30 * 40
    np.testing.assert_array_equal(image.color[~image.mask], photo[~image.mask])
    np.testing.assert_allclose(image.color[image.mask], 1.0, rtol=1e-5)
    assert float(jnp.abs(image.normals[~image.mask]).max()) == 0


def test_irradiance_and_its_rule_are_those_of_the_basis(x64):
    rng = np.random.default_rng(4)
    normals, light = jnp.asarray(rng.normal(size=(5, 3))), jnp.asarray(rng.normal(size=(9, 3)))

    def plain(normals, light):
        return sh_basis(normals) @ light

    slope = jax.vmap(jax.jacfwd(plain), (0, None))(normals, light)
    np.testing.assert_allclose(irradiance_slope(normals, light), slope, atol=1e-12)
    probe = jnp.asarray(rng.normal(size=(5, 3)))
    ours, theirs = (
        jax.grad(lambda n, c, f=f: jnp.sum(probe * f(n, c)), (0, 1))(normals, light)
        for f in (irradiance, plain)
    )
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)
    check_grads(irradiance, (normals, light), 2, ("fwd", "rev"), eps=1e-5)
