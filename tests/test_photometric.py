"""E_c: value, gradients, the structured Jacobian, reweighting, sampling."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax.flatten_util import ravel_pytree

from jaxface.energies._photometric_quadratic import (
    normal_modes,
    photometric_jacobian,
    photometric_quadratic,
)
from jaxface.energies.photometric import (
    PhotometricData,
    photometric_difference,
    photometric_energy,
    photometric_residual,
    reweighting,
    synthesize,
)
from jaxface.geometry.normal_stencil import normal_stencil
from jaxface.stages.fit.samples import thin_samples
from tests.small_scene import small_model, small_parameters, small_samples

# Compiled once for all the tests: their arguments have the same shapes.
value_and_gradient = jax.jit(jax.value_and_grad(photometric_energy))
quadratic_model = jax.jit(photometric_quadratic)
modes_of_normals = jax.jit(normal_modes)


@pytest.fixture(scope="module")
def double_scene():
    with jax.enable_x64(True):
        model = small_model()
        shadow = np.random.default_rng(5).normal(size=(model.vertex_count, 9))
        slope = np.random.default_rng(6).normal(size=(model.vertex_count, 3, 9))
        model = dataclasses.replace(
            model, occlusion=jnp.asarray(0.1 * shadow), occlusion_slope=jnp.asarray(0.3 * slope)
        )
        y = small_parameters(model)
        samples = small_samples(model, y)
        stencil = normal_stencil(np.asarray(model.faces), model.vertex_count)
    return model, y, samples, stencil


@pytest.fixture
def scene(double_scene, x64):
    return double_scene


def test_energy_is_the_weighted_mean_of_unsquared_norms(scene):
    model, y, samples, _ = scene
    difference = np.asarray(samples.color - synthesize(y, model, samples))
    weight = np.asarray(samples.weight)
    expected = (weight * np.linalg.norm(difference, axis=1)).sum() / weight.sum()
    assert float(photometric_energy(y, PhotometricData(model, samples))) == pytest.approx(expected)


def test_gradient_forward_reverse_and_finite_differences(scene):
    model, y, samples, _ = scene
    data = PhotometricData(model, samples)
    flat, unravel = ravel_pytree(y)

    @jax.jit
    def energy(x):
        return photometric_energy(unravel(x), data)

    reverse = ravel_pytree(value_and_gradient(y, data)[1])[0]
    forward = jax.jit(jax.jacfwd(energy))(flat)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-12)
    for seed in range(4):
        direction = jnp.asarray(np.random.default_rng(seed).normal(size=flat.shape))
        step = 1e-5
        central = (energy(flat + step * direction) - energy(flat - step * direction)) / (2 * step)
        assert float(reverse @ direction) == pytest.approx(float(central), rel=1e-5)


def test_structured_jacobian_equals_autodiff(scene):
    model, y, samples, stencil = scene
    flat, unravel = ravel_pytree(y)
    modes = modes_of_normals(y, model, stencil)
    color, jacobian = jax.jit(photometric_jacobian)(y, model, modes, samples)
    reference = jax.jit(jax.jacfwd(lambda x: synthesize(unravel(x), model, samples)))(flat)
    used = np.asarray(samples.weight > 0)
    np.testing.assert_allclose(color[used], synthesize(y, model, samples)[used], rtol=1e-10)
    np.testing.assert_allclose(
        jacobian[used], reference[used], atol=1e-10 * np.abs(reference).max()
    )


def test_quadratic_gradient_is_exact_with_and_without_thinned_curvature(scene):
    model, y, samples, stencil = scene
    data = PhotometricData(model, samples)
    modes = modes_of_normals(y, model, stencil)
    full = quadratic_model(y, data, modes)
    thinned = quadratic_model(y, data, modes, thin_samples(samples, 200))
    expected = ravel_pytree(value_and_gradient(y, data)[1])[0]
    np.testing.assert_allclose(full.gradient, expected, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(thinned.gradient, expected, rtol=1e-8, atol=1e-12)
    relative = np.linalg.norm(thinned.curvature - full.curvature) / np.linalg.norm(full.curvature)
    assert relative < 0.3
    assert np.linalg.eigvalsh(np.asarray(full.curvature)).min() > -1e-12


def test_reweighted_residual_has_the_gradient_of_the_energy(scene):
    model, y, samples, _ = scene
    data = PhotometricData(model, samples)
    squared = jax.jit(jax.grad(lambda p: jnp.sum(photometric_residual(p, data) ** 2)))(y)
    energy = value_and_gradient(y, data)[1]
    for a, b in zip(jax.tree.leaves(squared), jax.tree.leaves(energy), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-12)


def test_exact_match_has_zero_energy_and_finite_gradient(scene):
    model, y, samples, stencil = scene
    perfect = samples.__class__(
        samples.position, samples.triangle, synthesize(y, model, samples), samples.weight,
        samples.principal,
    )  # fmt: skip
    data = PhotometricData(model, perfect)
    value, gradient = value_and_gradient(y, data)
    assert float(value) < 1e-14
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    quadratic = quadratic_model(y, data, modes_of_normals(y, model, stencil))
    assert np.isfinite(quadratic.curvature).all()


def test_no_visible_pixel_gives_zero_without_nan(scene):
    model, y, samples, _ = scene
    empty = samples.__class__(
        samples.position, samples.triangle, samples.color, 0 * samples.weight, samples.principal
    )
    value, gradient = value_and_gradient(y, PhotometricData(model, empty))
    assert float(value) == 0.0
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


def test_degenerate_triangle_gives_finite_derivatives(scene):
    model, y, samples, _ = scene
    collapsed = samples.triangle.at[0].set(samples.triangle[0, 0])
    broken = samples.__class__(
        samples.position, collapsed, samples.color, samples.weight, samples.principal
    )
    gradient = value_and_gradient(y, PhotometricData(model, broken))[1]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


@given(st.lists(st.floats(1e-3, 2.0), min_size=8, max_size=8), st.floats(0.1, 10.0))
def test_irls_majorises_the_norm(norms, factor):
    """At weights taken at d0, sum w ||d||^2 + const lies above sum ||d|| and touches at d0."""
    start = np.array(norms)
    moved = start * np.random.default_rng(int(1e4 * factor)).uniform(0, factor, len(start))
    difference = jnp.asarray(np.stack([start, 0 * start, 0 * start], axis=1), jnp.float32)
    weight = np.asarray(reweighting(difference, jnp.ones(len(start))))
    assert (weight * start**2).sum() == pytest.approx(start.mean() / 2, rel=1e-4)
    majoriser = (weight * moved**2).sum() + start.mean() / 2
    assert majoriser >= moved.mean() - 1e-5


# The capacity is a shape: few of them, as each is compiled anew.
@given(st.integers(1, 400), st.sampled_from([1, 2, 37, 150, 300]))
def test_thinned_samples_are_valid_distinct_and_even(seed, capacity):
    rng = np.random.default_rng(seed)
    from jaxface.energies.photometric import PixelSamples

    weight = rng.uniform(0.1, 1, 300) * (rng.uniform(size=300) < rng.uniform())
    position = np.stack([np.arange(300.0), np.zeros(300)], axis=1)
    samples = PixelSamples(
        jnp.asarray(position, jnp.float32), jnp.zeros((300, 3), jnp.int32), jnp.zeros((300, 3)),
        jnp.asarray(weight, jnp.float32), jnp.zeros(2),
    )  # fmt: skip
    thin = thin_samples(samples, capacity)
    used = np.asarray(thin.weight) > 0
    count = int((weight > 0).sum())
    assert used.sum() == min(capacity, count)
    chosen = np.asarray(thin.position)[used, 0].astype(int)
    assert len(set(chosen)) == len(chosen)
    np.testing.assert_allclose(np.asarray(thin.weight)[used], weight[chosen], rtol=1e-6)
    rank = np.cumsum(weight > 0)[chosen]
    if len(rank) > 1:
        assert np.ptp(np.diff(rank)) <= 1


def test_difference_is_zero_where_unused(scene):
    model, y, samples, _ = scene
    difference = photometric_difference(y, PhotometricData(model, samples))
    assert not np.asarray(difference)[np.asarray(samples.weight) == 0].any()
