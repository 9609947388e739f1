"""A picture of a mesh: its derivatives in every input, against differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxface.geometry.camera import Camera, Pose
from jaxface.render.image import render

HEIGHT, WIDTH = 45, 61


def head():
    """A bumpy closed surface of 320 triangles, millimetres, with a colour at each vertex."""
    trimesh = pytest.importorskip("trimesh")
    sphere = trimesh.creation.icosphere(subdivisions=2)
    rng = np.random.default_rng(0)
    vertices = np.asarray(sphere.vertices) * [70.0, 95.0, 80.0] + rng.normal(0, 1.5, (162, 3))
    return vertices, np.asarray(sphere.faces), rng.uniform(0.2, 0.9, (162, 3))


PARTS = ("vertices", "albedo", "pose", "camera", "light")


@pytest.fixture(scope="module")
def picture():
    """The inputs of a picture by name, and its derivative in a direction by three routes."""
    with jax.enable_x64(True):
        vertices, faces, albedo = head()
        rng = np.random.default_rng(1)
        inputs = {
            "vertices": jnp.asarray(vertices),
            "albedo": jnp.asarray(albedo),
            "pose": Pose(jnp.array([0.1, 0.4, -0.05]), jnp.array([4.0, -3.0, -600.0])),
            "camera": Camera(jnp.asarray(120.0), jnp.array([31.0, 22.0])),
            "light": jnp.asarray(rng.normal(0, 0.3, (9, 3))).at[0].add(2.5),
        }
        weights = jnp.asarray(rng.normal(size=(HEIGHT, WIDTH, 3)))

        @jax.jit
        def draw(values):
            return render(**values, faces=jnp.asarray(faces), height=HEIGHT, width=WIDTH)

        def moved(step, h):
            return draw(jax.tree.map(lambda v, s: v + h * s, inputs, step))

        def loss(values, fixed):
            return jnp.sum(jnp.where(fixed[..., None], weights * draw(values).color, 0.0))

        along = jax.jit(
            lambda step, fixed: jax.jvp(lambda v: loss(v, fixed), (inputs,), (step,))[1]
        )
        slope = jax.jit(jax.grad(loss))

        def derivatives(step, h):
            ahead, behind = moved(step, h), moved(step, -h)
            fixed = (ahead.fragments.triangle == behind.fragments.triangle) & ahead.mask
            color = jnp.where(fixed[..., None], weights * (ahead.color - behind.color), 0.0)
            gradient = slope(inputs, fixed)
            reverse = sum(
                jnp.sum(g * s)
                for g, s in zip(jax.tree.leaves(gradient), jax.tree.leaves(step), strict=True)
            )
            return jnp.sum(fixed), jnp.sum(color) / (2 * h), along(step, fixed), reverse

    return inputs, derivatives


@pytest.mark.parametrize("part", PARTS)
def test_derivatives_of_the_picture_equal_differences(part, picture):
    inputs, derivatives = picture
    with jax.enable_x64(True):
        rng = np.random.default_rng(2)
        size = {"camera": 0.3, "pose": 0.01}.get(part, 1.0)
        step = {
            name: jax.tree.map(
                lambda v, on=name == part: jnp.asarray(size * on * rng.normal(size=v.shape)), value
            )
            for name, value in inputs.items()
        }
        fixed, difference, forward, reverse = map(float, derivatives(step, 1e-5))
    assert fixed > 400
    scale = abs(difference) + 1e-3
    assert abs(forward - reverse) < 1e-9 * scale
    assert abs(forward - difference) < 1e-5 * scale
