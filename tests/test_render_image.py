"""A picture of a mesh: its derivatives in every input, against differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxface.geometry.camera import Camera, Pose
from jaxface.imaging.mipmap import mipmap
from jaxface.render.image import render, render_textured
from jaxface.render.shading import ambient_light, sh_basis

HEIGHT, WIDTH = 45, 61


def head():
    """A bumpy closed surface of 320 triangles, millimetres, with a colour at each vertex."""
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


def plane():
    """A square of 20 mm in two triangles, 200 mm in front of a camera that it fills."""
    corners = jnp.array([[-10.0, -10, 0], [10, -10, 0], [10, 10, 0], [-10, 10, 0]])
    faces = jnp.array([[0, 1, 2], [0, 2, 3]])
    uv = (corners[:, :2] + 10) / 20
    return corners, faces, uv, Pose(jnp.zeros(3), jnp.array([0.0, 0, -200]))


def textured(texture, side, focal, **more):
    corners, faces, uv, pose = plane()
    camera = Camera(jnp.asarray(focal), jnp.full(2, side / 2))
    light = more.pop("light", ambient_light())
    return render_textured(
        corners, faces, texture, uv, faces, pose, camera, light, side, side, **more
    )


def test_a_texture_facing_the_camera_is_its_picture_pixel_for_pixel():
    image = np.random.default_rng(3).uniform(0.1, 0.9, (32, 32, 3)).astype(np.float32)
    drawn = textured(mipmap(jnp.asarray(image)), 32, 320.0)
    assert bool(drawn.mask.all())
    np.testing.assert_allclose(np.asarray(drawn.color), image, atol=2e-5)


@pytest.mark.parametrize("shrunk", [2, 4])
def test_a_texture_that_is_farther_away_is_averaged_and_does_not_alias(shrunk):
    side = 32 // shrunk
    image = np.random.default_rng(4).uniform(0.1, 0.9, (32, 32, 3)).astype(np.float32)
    drawn = textured(mipmap(jnp.asarray(image)), side, 320.0 / shrunk)
    blocks = image.reshape(side, shrunk, side, shrunk, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(np.asarray(drawn.color), blocks, atol=2e-5)


def test_occlusion_is_taken_in_the_frame_of_the_mesh():
    """A light from the camera's right, hidden from the mesh's own right, which is turned up."""
    image = jnp.full((8, 8, 3), 0.5)
    light = ambient_light(2.0) + 0.3 * jnp.asarray(sh_basis(jnp.array([1.0, 0, 0])))[:, None]
    corners, faces, uv, pose = plane()
    quarter = Pose(jnp.array([0.0, 0.0, np.pi / 2]), pose.translation)
    # The light of the camera's right comes, seen from the turned mesh, from below.
    below, right = (sh_basis(jnp.array(d)) for d in ([0.0, -1, 0], [1.0, 0, 0]))
    camera = Camera(jnp.asarray(80.0), jnp.full(2, 4.0))

    def drawn(hidden):
        occlusion = -0.2 * jnp.tile(hidden, (4, 1))
        return render_textured(
            corners, faces, mipmap(image), uv, faces, quarter, camera, light, 8, 8,
            occlusion=occlusion,
        ).color  # fmt: skip

    toward = 0.2 * float(right @ light[:, 0])
    plain = render_textured(
        corners, faces, mipmap(image), uv, faces, quarter, camera, light, 8, 8
    ).color
    np.testing.assert_allclose(np.asarray(plain - drawn(below)), 0.5 * toward, rtol=1e-4)
    assert np.abs(np.asarray(drawn(right) - drawn(below))).min() > 0.01


@pytest.mark.parametrize("side", [16, 256])
def test_derivatives_of_the_textured_picture_equal_differences(side):
    """On one triangle of 80 pixels that fills the picture: magnified, and from the mipmap."""
    with jax.enable_x64(True):
        rng = np.random.default_rng(5)
        faces, uv = jnp.array([[0, 1, 2]]), jnp.array([[0.0, 0.1], [1.0, 0.0], [0.6, 1.0]])
        coarse = jnp.asarray(rng.uniform(0.1, 0.9, (9, 9, 3)))
        inputs = {
            "texture": jax.image.resize(coarse, (side, side, 3), "cubic"),
            "vertices": jnp.array([[-90.0, -60, 0], [90, -60, -15], [0, 130, 10]]),
            "pose": Pose(jnp.array([0.1, -0.2, 0.05]), jnp.array([2.0, -3.0, -200.0])),
            "camera": Camera(jnp.asarray(90.0), jnp.array([6.2, 5.9])),
            "light": jnp.asarray(rng.normal(0, 0.2, (9, 3))).at[0].add(2.5),
        }
        weights = jnp.asarray(rng.normal(size=(12, 12, 3)))

        @jax.jit
        def loss(values):
            drawn = render_textured(
                values["vertices"], faces, mipmap(values["texture"]), uv, faces, values["pose"],
                values["camera"], values["light"], 12, 12,
            )  # fmt: skip
            return jnp.sum(weights * drawn.color)

        forward = jax.jit(lambda step: jax.jvp(loss, (inputs,), (step,))[1])
        slope = jax.jit(jax.grad(loss))(inputs)
        for part, value in inputs.items():
            size = {"pose": 1e-3, "camera": 0.1}.get(part, 1.0)
            random = jax.tree.map(lambda v, k=size: k * rng.normal(size=v.shape), value)
            step = {**jax.tree.map(jnp.zeros_like, inputs), part: random}
            ahead, behind = (
                float(loss(jax.tree.map(lambda v, s, k=h: v + k * s, inputs, step)))
                for h in (1e-5, -1e-5)
            )
            difference, along = (ahead - behind) / 2e-5, float(forward(step))
            pairs = zip(jax.tree.leaves(slope), jax.tree.leaves(step), strict=True)
            reverse = sum(float(jnp.vdot(g, s)) for g, s in pairs)
            assert abs(along - difference) < 1e-5 * (abs(difference) + 1e-3), part
            assert abs(reverse - along) < 1e-10 * (abs(along) + 1e-3), part
