"""Views of a complete face: its texture in a studio's light."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxface.io.models import load_model
from jaxface.models.parameters import neutral_parameters
from jaxface.pipeline.face_views import SIDE, VIEWS, face_views, studio_light
from jaxface.render.occlusion import sphere_lattice
from jaxface.render.shading import irradiance


@pytest.fixture(scope="module")
def views():
    model = load_model("makehuman")
    albedo = np.full((64, 64, 3), (0.5, 0.3, 0.2), np.float32)
    return face_views(model, neutral_parameters(model), albedo)


def test_every_view_shows_the_head_whole_and_the_last_the_face(views):
    assert [title for title, _ in views] == [*VIEWS, "no expression"]
    for title, picture in views:
        assert picture.shape == (SIDE, SIDE, 3)
        head = np.ptp(picture, axis=-1) > 0.05  # the background is grey
        rim = np.concatenate([head[0], head[-1], head[:, 0], head[:, -1]])
        assert rim.any() == (title not in VIEWS)
        assert 0.15 < head.mean() < 0.9


def test_the_front_is_upright_and_symmetric_and_the_sides_are_mirror_images(views):
    heads = [np.ptp(picture, axis=-1) > 0.05 for _, picture in views[:3]]
    right, front, left = heads
    assert (front != front[:, ::-1]).mean() < 0.01
    assert (right != left[:, ::-1]).mean() < 0.01
    # Neck and shoulders, below, are narrower than the head.
    rows = front.sum(axis=1)
    assert rows[: SIDE // 2].max() > rows[SIDE // 2 :].max()


def test_the_studio_lights_every_side_and_more_from_the_front():
    directions = sphere_lattice(500)
    shading = np.asarray(irradiance(jnp.asarray(directions, jnp.float32), studio_light()))
    assert shading.min() > 0
    front = directions[:, 2] > 0.5
    assert shading[front].mean() > 2 * shading[directions[:, 2] < -0.5].mean()
    assert 0.8 < shading[front].mean() < 1.5
