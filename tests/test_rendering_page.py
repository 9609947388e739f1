"""The page on rendering: its code runs in order, and what it says is so."""

import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

PAGE = Path(__file__).resolve().parent.parent / "docs" / "rendering.md"


@pytest.fixture(scope="module")
def page() -> dict:
    names: dict = {}
    bodies = re.findall(r"^```python\n(.*?)^```", PAGE.read_text("utf-8"), re.M | re.S)
    for number, body in enumerate(bodies):
        exec(compile(body, f"rendering.md, block {number + 1}", "exec"), names)
    return names


def test_the_face_turns_to_its_left_and_is_lit_from_there(page):
    picture = page["picture"]
    assert picture.color.shape == (48, 48, 3) and 0.2 < float(picture.mask.mean()) < 0.9
    # +x is the subject's left, the image's right: the tip of the nose goes there from the eyes.
    inside = np.asarray(picture.mask)
    points = page["camera"].project(page["pose"](page["model"].landmarks68(page["vertices"])))
    assert float(points[30, 0]) > float(points[jnp.array([36, 45]), 0].mean()) + 2
    lit, shaded = (
        float(picture.color[inside & (np.sign(picture.normals[..., 0]) == side)].mean())
        for side in (1, -1)
    )
    assert lit > 1.1 * shaded
    np.testing.assert_array_equal(picture.fragments.triangle >= 0, picture.mask)


def test_the_gradient_in_the_light_is_that_of_the_brightness(page):
    """Brightness is linear in the light."""
    slope, light = np.asarray(page["to_light"]), np.asarray(page["light"])
    value = float(page["brightness"](page["pose"], page["light"]))
    np.testing.assert_allclose(np.sum(slope * light), value, rtol=1e-3)
    assert np.abs(page["to_pose"].rotation).max() > 0


def test_the_light_is_found_again(page):
    assert bool(page["found"].converged)
    np.testing.assert_allclose(page["found"].value, page["light"], atol=0.02)


def test_the_texture_keeps_what_is_known_and_gets_the_statistics(page):
    found = page["texture"]
    assert found.values[-1] < 0.2 * found.values[0]
    assert set(found.terms) == {"style", "photo", "plain"}
    away = np.abs(np.asarray(found.image - page["exemplar"]))
    assert away[:, :14].mean() < 0.5 * away[:, 18:].mean()
