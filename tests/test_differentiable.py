"""The gradient from a complete texture back to the photo and to the weights of the energies."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxface.geometry.normal_stencil import normal_stencil
from jaxface.geometry.uv import uv_layout
from jaxface.imaging.colour import linear_to_srgb, rgb_to_yiq
from jaxface.networks.texture_features.random_weights import random_network
from jaxface.pipeline.differentiable import TextureProblem, TextureWeights, infer_texture
from jaxface.render.image import render
from jaxface.stages._unwrap import unwrap
from jaxface.stages.fit import (
    FitConfig,
    FitInput,
    FitModel,
    FitWeights,
    fit_hidden_shading,
    fit_parameters,
)
from tests.small_scene import small_model, small_parameters

SIZE, RESOLUTION = 32, 24


@pytest.fixture(scope="module")
def case():
    """A bump, its photo with a little noise, and a database of three textures."""
    with jax.enable_x64(True):
        model = small_model(10)
        wide = lambda tree: jax.tree.map(  # noqa: E731
            lambda x: x.astype(jnp.float64) if x.dtype == jnp.float32 else x, tree
        )
        count = model.faces.shape[0]
        prepared = FitModel(
            model=model,
            stencil=normal_stencil(np.asarray(model.faces), model.vertex_count),
            points=model.landmarks68,
            contour=jnp.zeros(0, jnp.int32),
            outline=jnp.arange(4, dtype=jnp.int32),
            vertex_mask=jnp.ones(model.vertex_count, bool),
            face_mask=jnp.ones(count, bool),
        )
        truth = small_parameters(model)
        principal = jnp.array([0.5, 0.5])
        shape = model.shape(truth.identity, truth.expression)
        camera = truth.camera(principal, SIZE)
        picture = render(
            shape, model.reflectance(truth.albedo), model.faces, truth.pose, camera, truth.light,
            SIZE, SIZE,
        )  # fmt: skip
        rng = np.random.default_rng(0)
        image = picture.color + 0.02 * rng.normal(size=(SIZE, SIZE, 3))
        marks = prepared.points(truth.pose(shape))
        photo = FitInput(
            image=jnp.asarray(image),
            mask=picture.mask.astype(jnp.float64),
            landmarks=truth.camera(principal).project(marks)[:, :2],
            landmark_weight=jnp.ones(12),
            landmark_unit=jnp.asarray(0.3),
            principal=principal,
            log_focal=truth.log_focal,
            log_focal_deviation=jnp.asarray(0.05),
            estimate_inliers=jnp.asarray(False),
        )
        layout = wide(uv_layout(model.uv, model.uv_faces, RESOLUTION, gutter=1))
        # Subjects on both sides of the truth, so that the blend lies inside the simplex.
        albedo = layout(model.reflectance(truth.albedo), model.faces)
        own = rgb_to_yiq(linear_to_srgb(jnp.clip(albedo, 0.05, 1.0)))[..., 0]
        noise = 0.1 * rng.normal(size=(RESOLUTION, RESOLUTION))
        grid = jnp.stack([own + noise, own - noise, 0.9 * own, 1.1 * own])
        network = wide(random_network(((1, 4), (1, 6)), seed=2))
        visible = np.zeros((RESOLUTION, RESOLUTION), bool)
        visible[6:18, 6:18] = True
        problem = TextureProblem((prepared,), layout, network, grid, jnp.asarray(visible))
        weights = TextureWeights(
            {"conv1_1": jnp.asarray(1.0), "conv2_1": jnp.asarray(0.7)}, jnp.asarray(2.0)
        )
        fit_weights = FitWeights(*(jnp.asarray(x) for x in (1.0, 10.0, 1e-3, 0.0, 0.0, 1e-3, 1e-3)))
    return photo, fit_weights, weights, problem


@pytest.mark.slow
def test_gradient_from_texture_to_photo_and_weights(case):
    photo, fit_weights, weights, problem = case
    config = FitConfig(steps=(60,), landmark_steps=20, curvature_pixels=SIZE**2, rtol=1e-13)
    with jax.enable_x64(True):
        probe = jnp.asarray(np.random.default_rng(5).normal(size=(RESOLUTION, RESOLUTION)))

        @jax.jit
        def loss(image, fit_weights, weights):
            data = dataclasses.replace(photo, image=image)
            found = infer_texture(data, fit_weights, weights, problem, config, steps=2)
            return jnp.sum(probe * found.image), found

        (_, found), gradient = jax.jit(jax.value_and_grad(loss, (0, 1, 2), has_aux=True))(
            photo.image, fit_weights, weights
        )
        assert np.isfinite(np.asarray(found.image)).all()
        assert float(jnp.sum(found.weights)) == pytest.approx(1)

        def check(direction, step, tolerance):
            def at(sign):
                moved = jax.tree.map(
                    lambda x, d: x + sign * step * d, (photo.image, fit_weights, weights), direction
                )
                return float(loss(*moved)[0])

            numeric = (at(1) - at(-1)) / (2 * step)
            ours = sum(
                float(jnp.sum(g * d))
                for g, d in zip(jax.tree.leaves(gradient), jax.tree.leaves(direction), strict=True)
            )
            assert abs(numeric) > 1e-9
            assert ours == pytest.approx(numeric, rel=tolerance)

        zero = jax.tree.map(jnp.zeros_like, (photo.image, fit_weights, weights))
        pixels = jnp.zeros_like(photo.image).at[SIZE // 2, SIZE // 2].set(1.0)
        check((pixels, zero[1], zero[2]), 1e-5, 1e-2)
        prior = eqx.tree_at(lambda w: w.prior, zero[1], jnp.asarray(1.0))
        check((zero[0], prior, zero[2]), 1e-7, 1e-2)
        alpha = eqx.tree_at(lambda w: w.alpha, zero[2], jnp.asarray(1.0))
        check((zero[0], zero[1], alpha), 1e-5, 1e-4)
        layer = eqx.tree_at(lambda w: w.layers["conv2_1"], zero[2], jnp.asarray(1.0))
        check((zero[0], zero[1], layer), 1e-5, 1e-3)


@pytest.mark.slow
def test_albedo_is_freed_of_the_shadows_that_the_fit_saw(case):
    photo, fit_weights, weights, problem = case
    with jax.enable_x64(True):
        shadowed = problem.models[0].with_occlusion(
            jnp.zeros((problem.models[0].model.vertex_count, 9)).at[:, 0].set(-0.05)
        )
        problem = dataclasses.replace(problem, models=(shadowed, shadowed))
        config = FitConfig(steps=(2, 2), landmark_steps=4, shadow_directions=32)
        y, stats = jax.jit(fit_parameters)(photo, problem.models, fit_weights, config)
        found = jax.jit(infer_texture)(photo, fit_weights, weights, problem, config)

        def freed(*occlusion):
            model = shadowed.with_occlusion(*occlusion).model
            shape = y.pose(model.shape(y.identity, y.expression))
            return unwrap(
                photo.image, photo.mask, shape, model.faces, y.camera(photo.principal, SIZE),
                y.light, problem.layout, fit_hidden_shading(y, model), tile=RESOLUTION,
            ).albedo  # fmt: skip

        cast = freed(stats.occlusion, stats.occlusion_slope)
        np.testing.assert_allclose(found.partial.albedo, cast, atol=1e-9)
        soft = freed(shadowed.model.occlusion)
        assert float(jnp.max(jnp.abs(found.partial.albedo - soft))) > 1e-3
