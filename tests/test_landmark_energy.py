"""E_lan, sliding contours, priors: values against the formula, gradients, singular points."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.flatten_util import ravel_pytree

from jaxface.energies.landmark import LandmarkData, landmark_difference, landmark_residual
from jaxface.energies.prior import focal_residual, light_residual, prior_residual
from jaxface.geometry.rotation import rotation_matrix
from jaxface.models.morphable import SurfacePoints
from jaxface.stages.fit.contour import slide_contour
from tests.small_scene import small_model, small_parameters


@pytest.fixture
def landmark_scene(x64):
    model = small_model()
    y = small_parameters(model)
    rng = np.random.default_rng(5)
    data = LandmarkData(
        model=model,
        points=model.landmarks68,
        target=jnp.asarray(rng.uniform(0.2, 0.8, (12, 2))),
        weight=jnp.asarray(rng.uniform(0.5, 1, 12)),
        principal=jnp.array([0.5, 0.45]),
        unit=jnp.asarray(0.3),
    )
    return model, y, data


def test_value_is_the_formula_of_the_paper(landmark_scene):
    model, y, data = landmark_scene
    vertices = np.asarray(model.shape(y.identity, y.expression))
    points = np.einsum(
        "li,lij->lj", data.points.weights, vertices[np.asarray(data.points.vertices)]
    )
    posed = points @ np.asarray(rotation_matrix(y.rotation)).T + np.asarray(y.translation)
    focal = np.exp(float(y.log_focal))
    x = 0.5 + focal * posed[:, 0] / -posed[:, 2]
    down = 0.45 - focal * posed[:, 1] / -posed[:, 2]
    distance = np.linalg.norm(np.stack([x, down], 1) - np.asarray(data.target), axis=1) / 0.3
    weight = np.asarray(data.weight) / np.asarray(data.weight).sum()
    value = float(jnp.sum(landmark_residual(y, data) ** 2))
    assert value == pytest.approx((weight * distance**2).sum(), rel=1e-10)


@pytest.mark.parametrize("term", ["landmark", "prior", "focal", "light"])
def test_gradients(landmark_scene, term):
    _, y, data = landmark_scene
    flat, unravel = ravel_pytree(y)
    residual = {
        "landmark": lambda p: landmark_residual(p, data),
        "prior": prior_residual,
        "focal": lambda p: focal_residual(p, (jnp.asarray(0.2), jnp.asarray(0.3))),
        "light": light_residual,
    }[term]

    def energy(x):
        return jnp.sum(ravel_pytree(residual(unravel(x)))[0] ** 2)

    reverse, forward = jax.grad(energy)(flat), jax.jacfwd(energy)(flat)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-11)
    direction = jnp.asarray(np.random.default_rng(0).normal(size=flat.shape))
    central = (energy(flat + 1e-5 * direction) - energy(flat - 1e-5 * direction)) / 2e-5
    assert float(reverse @ direction) == pytest.approx(float(central), rel=1e-6, abs=1e-9)


def test_a_landmark_of_weight_zero_takes_no_part_and_has_derivatives(landmark_scene):
    _, y, data = landmark_scene

    def row_of(weight):
        return landmark_residual(y, eqx.tree_at(lambda d: d.weight, data, weight))

    weight = data.weight.at[3].set(0.0)
    rows = row_of(weight)
    others = jnp.delete(weight, 3)
    np.testing.assert_array_equal(rows[3], 0.0)
    assert float(jnp.sum(others) / jnp.sum(weight)) == 1.0
    forward, reverse = jax.jacfwd(row_of)(weight), jax.jacrev(row_of)(weight)
    assert np.isfinite(forward).all()
    np.testing.assert_allclose(forward, reverse, atol=1e-12)


@settings(max_examples=10)
@given(scale=st.floats(1e-3, 1e3), seed=st.integers(0, 99))
def test_weights_count_by_their_shares(scale, seed):
    rng = np.random.default_rng(seed)
    model = small_model(5)
    points = SurfacePoints(model.landmarks68.vertices, model.landmarks68.weights)
    y, weight = small_parameters(model), jnp.asarray(rng.uniform(0, 1, 12) * (rng.random(12) < 0.8))
    target = jnp.asarray(rng.uniform(0.2, 0.8, (12, 2)))
    data = LandmarkData(model, points, target, weight, jnp.full(2, 0.5), jnp.asarray(0.3))
    scaled = eqx.tree_at(lambda d: d.weight, data, scale * weight)
    one, other = landmark_residual(y, data), landmark_residual(y, scaled)
    np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5 * float(jnp.abs(one).max()))
    distance = jnp.sum(landmark_difference(y, data) ** 2, axis=1) / 0.3**2
    assert float(jnp.sum(one**2)) <= 1.001 * float(distance.max()) + 1e-6


@settings(max_examples=10)
@given(factor=st.floats(0.01, 100.0), seed=st.integers(0, 99))
def test_light_prior_does_not_know_the_exposure_and_priors_are_even(factor, seed):
    rng = np.random.default_rng(seed)
    y = small_parameters(small_model(5), seed)
    light = jnp.asarray(rng.normal(size=(9, 3))).at[0].set(rng.uniform(0.5, 2.0, 3))
    y = eqx.tree_at(lambda p: p.light, y, light)
    brighter = eqx.tree_at(lambda p: p.light, y, factor * light)
    if factor * float(jnp.mean(light[0])) > 2e-3:
        np.testing.assert_allclose(light_residual(brighter), light_residual(y), rtol=1e-4)
    turned = jax.tree.map(lambda x: -x, y)
    for one, other in zip(*(jax.tree.leaves(prior_residual(p)) for p in (y, turned)), strict=True):
        np.testing.assert_array_equal(one, -other)
    centre = y.log_focal + factor
    above, below = (focal_residual(y, (c, 0.3)) for c in (centre, 2 * y.log_focal - centre))
    assert float(above) == pytest.approx(-float(below), rel=1e-3)


def test_prior_counts_every_coefficient_once(landmark_scene):
    _, y, _ = landmark_scene
    expected = sum(float(jnp.sum(z**2)) for z in (y.identity, y.expression, y.albedo))
    residuals = prior_residual(y)
    assert sum(float(jnp.sum(r**2)) for r in residuals.values()) == pytest.approx(expected)


def test_light_prior_is_finite_in_the_dark(landmark_scene):
    _, y, _ = landmark_scene
    dark = y.__class__(
        y.identity, y.expression, y.albedo, 0 * y.light, y.rotation, y.translation, y.log_focal
    )
    gradient = jax.grad(lambda p: jnp.sum(light_residual(p) ** 2))(dark)
    assert np.isfinite(gradient.light).all()


def test_landmarks_at_the_camera_stay_finite(landmark_scene):
    _, y, data = landmark_scene
    behind = y.__class__(
        y.identity, y.expression, y.albedo, y.light, y.rotation, 0 * y.translation, y.log_focal
    )
    gradient = jax.grad(lambda p: jnp.sum(landmark_residual(p, data) ** 2))(behind)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


def test_hidden_contour_slides_to_the_silhouette(x64):
    """On a sphere the outline is a circle: a hidden point must land on it, near its target."""
    model = _sphere_model()
    y = small_parameters(model, spread=0.0)
    vertices = np.asarray(model.mean)
    hidden = int(np.argmin(vertices[:, 2]))
    front = int(np.argmax(vertices[:, 2]))
    points = SurfacePoints(
        jnp.array([[hidden] * 3, [front] * 3]), jnp.tile(jnp.array([1.0, 0.0, 0.0]), (2, 1))
    )
    posed = y.pose(model.mean)
    screen = np.asarray(y.camera(jnp.array([0.5, 0.5])).project(posed)[:, :2])
    centre = screen[front]
    radius = np.linalg.norm(screen - screen.mean(0), axis=1).max()
    target = np.stack([centre + [radius, 0.0], centre])
    data = LandmarkData(
        model, points, jnp.asarray(target), jnp.ones(2), jnp.array([0.5, 0.5]), jnp.asarray(radius)
    )
    slid = slide_contour(y, data, jnp.array([0, 1]), jnp.arange(len(vertices)))
    landed = int(slid.points.vertices[0, 0])
    assert landed != hidden
    assert np.linalg.norm(screen[landed] - target[0]) < 0.25 * radius
    assert int(slid.points.vertices[1, 0]) == front
    far = LandmarkData(
        model, points, jnp.asarray(target + 50 * radius), jnp.ones(2), data.principal, data.unit
    )
    dropped = slide_contour(y, far, jnp.array([0, 1]), jnp.arange(len(vertices)))
    assert float(dropped.weight[0]) == 0.0
    assert float(dropped.weight[1]) == 1.0


def _sphere_model():
    from jaxface.models.linear import LinearBasis

    model = small_model(4)
    n, m = 24, 24
    theta, phi = np.meshgrid(np.linspace(0.05, np.pi - 0.05, n), np.arange(m) * 2 * np.pi / m)
    theta, phi = theta.T, phi.T
    unit = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)], -1)
    index = np.arange(n * m).reshape(n, m)
    a, b = index[:-1], index[1:]
    c, d = np.roll(b, -1, axis=1), np.roll(a, -1, axis=1)
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    count = n * m
    empty = LinearBasis(jnp.zeros((count, 3, 1)), jnp.ones(1))
    return model.__class__(
        jnp.asarray(80 * unit.reshape(-1, 3)), empty, empty, jnp.ones((count, 3)), empty,
        jnp.asarray(faces, jnp.int32), model.uv, jnp.asarray(faces, jnp.int32), model.landmarks68,
        None, jnp.zeros(count, jnp.int32), "sphere", ("face",), ("a",), "none",
    )  # fmt: skip
