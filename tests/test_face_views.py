"""Views of a complete face: its texture in a studio's light."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxface.geometry.uv import uv_layout
from jaxface.io.face_models import load_model
from jaxface.models.parameters import neutral_parameters
from jaxface.pipeline.texture.views import SIDE, VIEWS, face_views, studio_light
from jaxface.render.occlusion import sphere_lattice
from jaxface.render.shading import irradiance

RED, GREEN = np.array([0.6, 0.2, 0.2]), np.array([0.2, 0.6, 0.2])


@pytest.fixture(scope="module")
def model():
    return load_model("makehuman")


@pytest.fixture(scope="module")
def albedo(model):
    """Red where the face's own right is (x < 0 of the model's frame), green on its left."""
    layout = uv_layout(model.uv, model.uv_faces, 256)
    left = np.asarray(layout(model.mean[:, :1], model.faces)) > 0
    return np.where(left, GREEN, RED).astype(np.float32)


@pytest.fixture(scope="module")
def views(model, albedo):
    return face_views(model, neutral_parameters(model), albedo)


def heads(views):
    return [np.ptp(picture, axis=-1) > 0.05 for _, picture in views]  # the background is grey


def test_every_view_shows_the_head_whole_and_the_last_the_face(views):
    assert [title for title, _ in views] == [*VIEWS, "no expression"]
    for (title, picture), head in zip(views, heads(views), strict=True):
        assert picture.shape == (SIDE, SIDE, 3)
        rim = np.concatenate([head[0], head[-1], head[:, 0], head[:, -1]])
        assert rim.any() == (title not in VIEWS)
        assert 0.15 < head.mean() < 0.9


def test_the_front_is_upright_and_symmetric_and_the_sides_are_mirror_images(views):
    right, front, left = heads(views)[:3]
    assert (front != front[:, ::-1]).mean() < 0.01
    assert (right != left[:, ::-1]).mean() < 0.01
    # Neck and shoulders, below, are narrower than the head.
    rows = front.sum(axis=1)
    assert rows[: SIDE // 2].max() > rows[SIDE // 2 :].max()


def test_each_side_is_the_one_that_its_title_says_and_the_texture_is_not_mirrored(views):
    reddish = [np.mean(picture[..., 0] > picture[..., 1] + 0.1) for _, picture in views[:3]]
    greenish = [np.mean(picture[..., 1] > picture[..., 0] + 0.1) for _, picture in views[:3]]
    assert reddish[0] > 2 * greenish[0]
    assert greenish[2] > 2 * reddish[2]
    # Seen from the front the face's own right is on the picture's left.
    front = views[1][1]
    red = front[..., 0] > front[..., 1] + 0.1
    assert red[:, : SIDE // 2 - 20].mean() > 0.15
    assert not red[:, SIDE // 2 + 20 :].any()


def test_expression_counts_but_for_the_close_view_and_identity_in_all(model, albedo, views):
    neutral = neutral_parameters(model)
    jaw = dataclasses.replace(neutral, expression=neutral.expression + 1.0)
    wide = dataclasses.replace(neutral, identity=neutral.identity.at[0].add(2.0))
    for y, changed in ((jaw, [True, True, True, False]), (wide, [True] * 4)):
        moved = face_views(model, y, albedo)
        assert [
            bool(np.abs(a - b).mean() > 1e-3) for (_, a), (_, b) in zip(views, moved, strict=True)
        ] == changed


def test_the_studio_lights_every_side_and_more_from_the_front():
    directions = sphere_lattice(500)
    shading = np.asarray(irradiance(jnp.asarray(directions, jnp.float32), studio_light()))
    assert shading.min() > 0
    front = directions[:, 2] > 0.5
    assert shading[front].mean() > 2 * shading[directions[:, 2] < -0.5].mean()
    assert 0.8 < shading[front].mean() < 1.5
