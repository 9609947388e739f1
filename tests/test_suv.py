"""SUV colour space and the removal of specularity, on dichromatic images of known parts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxface.imaging.suv import remove_specular_peak, rgb_to_suv, suv_rotation, suv_to_rgb

SOURCE = jnp.array([1.0, 0.9, 0.7])


def dichromatic(size=48):
    """Diffuse part of two colours under smooth shading, and a round highlight."""
    y, x = np.mgrid[:size, :size] / size
    shading = 0.4 + 0.5 * x
    skin = np.where((y > 0.5)[..., None], [0.6, 0.38, 0.28], [0.55, 0.30, 0.24])
    diffuse = skin * shading[..., None] * np.asarray(SOURCE)
    peak = 0.4 * np.exp(-((x - 0.5) ** 2 + (y - 0.5) ** 2) / 0.01)
    return jnp.asarray(diffuse, jnp.float32), jnp.asarray(
        diffuse + peak[..., None] * np.asarray(SOURCE), jnp.float32
    )


def test_the_space_is_a_rotation_with_s_along_the_source():
    rotation = suv_rotation(SOURCE)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
    suv = rgb_to_suv(SOURCE, SOURCE)
    along = np.array([float(np.linalg.norm(SOURCE)), 0.0, 0.0])
    np.testing.assert_allclose(suv, along, atol=1e-6)
    colour = jnp.array([[0.2, 0.5, 0.1]])
    np.testing.assert_allclose(suv_to_rgb(rgb_to_suv(colour, SOURCE), SOURCE), colour, atol=1e-6)


def test_the_highlight_goes_and_the_diffuse_part_stays():
    diffuse, seen = dichromatic()
    found = remove_specular_peak(seen, SOURCE, chroma_blur=0.0)
    before, after = (float(jnp.sqrt(jnp.mean((x - diffuse) ** 2))) for x in (seen, found))
    assert after < 0.3 * before
    kept = rgb_to_suv(found, SOURCE)[..., 1:]
    np.testing.assert_allclose(kept, rgb_to_suv(seen, SOURCE)[..., 1:], atol=1e-5)


def test_pixels_outside_the_mask_are_left_alone():
    _, seen = dichromatic()
    mask = jnp.zeros(seen.shape[:2]).at[:, 10:30].set(1.0)
    found = remove_specular_peak(seen, SOURCE, mask)
    np.testing.assert_array_equal(found[:, 30:], seen[:, 30:])


def test_gradients_agree_with_differences_and_each_other(x64):
    _, seen = dichromatic(16)
    seen, colour = jnp.asarray(seen, float), jnp.asarray(SOURCE, float)

    def value(c):
        return jnp.sum(remove_specular_peak(seen, c, rounds=2) ** 2)

    step = jnp.array([1e-6, -2e-6, 1e-6])
    difference = (value(colour + step) - value(colour - step)) / 2
    forward = jax.jvp(value, (colour,), (step,))[1]
    reverse = jax.grad(value)(colour) @ step
    assert float(forward) == pytest.approx(float(reverse), rel=1e-6)
    assert np.isfinite(float(forward))
    assert float(difference) == pytest.approx(float(forward), rel=0.05)


def test_wrong_shapes_are_named():
    with pytest.raises(ValueError, match="rgb has shape"):
        remove_specular_peak(jnp.zeros((4, 4)), SOURCE)
    with pytest.raises(ValueError, match="mask has shape"):
        remove_specular_peak(jnp.zeros((4, 4, 3)), SOURCE, jnp.ones((3, 4)))
