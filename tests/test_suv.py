"""SUV colour space and the removal of specularity, on dichromatic images of known parts."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxface._compilation import quickest_compilation
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
    assert after < 0.035 * before  # 0.0194 measured
    assert float(jnp.max(jnp.abs(found - diffuse))) < 0.006  # 0.0031; the highlight is 0.4
    away = np.hypot(*(np.mgrid[:48, :48] / 48 - 0.5)) > 0.3
    np.testing.assert_allclose(found[away], seen[away], atol=1e-4)  # 5e-5
    kept = rgb_to_suv(found, SOURCE)[..., 1:]
    np.testing.assert_allclose(kept, rgb_to_suv(seen, SOURCE)[..., 1:], atol=1e-5)


def test_pixels_outside_the_mask_are_left_alone():
    _, seen = dichromatic()
    mask = jnp.zeros(seen.shape[:2]).at[:, 10:30].set(1.0)
    found = remove_specular_peak(seen, SOURCE, mask)
    np.testing.assert_array_equal(found[:, 30:], seen[:, 30:])


def test_gradients_agree_with_differences_and_each_other(x64):
    _, seen = dichromatic(16)
    rng = np.random.default_rng(7)
    # Without noise the proportions are equal all over, and their quantiles have corners.
    image = jnp.asarray(seen, float) + 0.01 * rng.normal(size=seen.shape)
    at = image, jnp.asarray(SOURCE, float)

    def value(image, colour):
        return jnp.sum(remove_specular_peak(image, colour, rounds=2) ** 2)

    quick = partial(jax.jit, compiler_options=quickest_compilation())
    there, slope = quick(value), quick(jax.grad(value, (0, 1)))(*at)
    along = quick(lambda direction: jax.jvp(value, at, direction)[1])
    for which in (0, 1):
        direction = [jnp.zeros_like(x) for x in at]
        direction[which] = jnp.asarray(rng.normal(size=at[which].shape))
        moved = [
            [x + sign * 1e-6 * d for x, d in zip(at, direction, strict=True)] for sign in (1, -1)
        ]
        difference = float(there(*moved[0]) - there(*moved[1])) / 2e-6
        forward, reverse = float(along(tuple(direction))), jnp.vdot(slope[which], direction[which])
        assert abs(forward) > 1
        assert forward == pytest.approx(float(reverse), rel=1e-9)
        assert difference == pytest.approx(forward, rel=1e-6)  # 3e-8 measured


def test_wrong_shapes_are_named():
    with pytest.raises(ValueError, match="rgb has shape"):
        remove_specular_peak(jnp.zeros((4, 4)), SOURCE)
    with pytest.raises(ValueError, match="mask has shape"):
        remove_specular_peak(jnp.zeros((4, 4, 3)), SOURCE, jnp.ones((3, 4)))
