"""Polygons, distances, erosion and dilation, soft edges, the face oval."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt
from skimage.draw import polygon2mask

from jaxface.imaging.masks import (
    dilate,
    distance_to,
    erode,
    feather,
    fill_polygon,
    smoothstep,
)
from jaxface.models.face_oval import face_oval, face_oval_mask
from jaxface.models.landmark_schemes import FACE_OVAL


def random_mask(seed: int, shape=(37, 52), density=0.02) -> np.ndarray:
    return np.random.default_rng(seed).random(shape) < density


@given(st.integers(0, 10**6), st.sampled_from([3, 5, 12]))
def test_fill_polygon_agrees_with_scikit_image(seed, corners):
    # Concave and self-crossing ones too, partly outside the image.
    points = np.random.default_rng(seed).uniform(-15, 60, (corners, 2)).astype(np.float32)
    ours = np.asarray(fill_polygon(jnp.asarray(points), 40, 50))
    theirs = polygon2mask((40, 50), points[:, ::-1] - 0.5)
    assert np.mean(ours != theirs) < 1e-3


def test_polygons_that_share_an_edge_neither_overlap_nor_leave_a_gap():
    left = jnp.array([[0.5, 0.5], [10.5, 0.5], [7.5, 9.5], [0.5, 9.5]])
    right = jnp.array([[10.5, 0.5], [19.5, 0.5], [19.5, 9.5], [7.5, 9.5]])
    both = fill_polygon(left, 12, 22).astype(int) + fill_polygon(right, 12, 22)
    whole = fill_polygon(jnp.array([[0.5, 0.5], [19.5, 0.5], [19.5, 9.5], [0.5, 9.5]]), 12, 22)
    np.testing.assert_array_equal(both, whole.astype(int))


@given(st.integers(0, 10**6), st.sampled_from([1, 4, 9]))
def test_distance_is_exact_up_to_its_limit(seed, limit):
    mask = random_mask(seed)
    expected = distance_transform_edt(~mask) if mask.any() else np.full(mask.shape, np.inf)
    ours = distance_to(jnp.asarray(mask), limit)
    np.testing.assert_allclose(ours, np.minimum(np.asarray(expected), limit), rtol=1e-6)


@pytest.mark.parametrize("radius", [0, 1, 1.5, 4])
def test_dilation_and_erosion_by_a_disc(radius):
    mask = random_mask(3)
    expected = distance_transform_edt(~mask) <= radius
    np.testing.assert_array_equal(dilate(jnp.asarray(mask), radius), expected)
    solid = ~mask
    np.testing.assert_array_equal(erode(jnp.asarray(solid), radius), ~expected)


def test_feather_is_zero_outside_and_rises_inwards():
    mask = jnp.zeros((30, 40), bool).at[5:25, 6:34].set(True)
    soft = np.asarray(feather(mask, 4.0))
    assert (soft[~np.asarray(mask)] == 0).all()
    row = soft[15, 6:20]
    assert 0 < row[0] < 0.1 and (np.diff(row) >= 0).all() and (row[4:] == 1).all()
    assert float(feather(mask, 0.0).sum()) == float(mask.sum())
    np.testing.assert_array_equal(jax.jit(feather, static_argnums=1)(mask, 4.0), soft)


def test_smoothstep_ends_flat(x64):
    slope = jax.grad(lambda x: smoothstep(x, 2.0, 4.0))
    assert smoothstep(jnp.array([1.0, 2.0, 3.0, 4.0, 9.0]), 2.0, 4.0).tolist() == [0, 0, 0.5, 1, 1]
    assert slope(2.0) == 0 and slope(4.0) == 0 and slope(3.0) == pytest.approx(0.75)


def test_face_oval_of_68_points_holds_all_of_them_and_some_forehead():
    angle = np.linspace(0, np.pi, 17)
    jaw = np.stack([100 - 60 * np.cos(angle), 100 + 80 * np.sin(angle)], axis=-1)
    brows = np.stack([np.linspace(50, 150, 10), np.full(10, 85.0)], axis=-1)
    inner = np.random.default_rng(0).uniform([70, 90], [130, 150], (41, 2))
    points = jnp.asarray(np.concatenate([jaw, brows, inner]))
    mask = np.asarray(face_oval_mask(points, 200, 200))
    assert all(mask[int(y), int(x)] for x, y in inner)
    assert mask[60, 100] and not mask[20, 100] and not mask[195, 100] and not mask[150, 30]
    soft = np.asarray(face_oval_mask(points, 200, 200, soft=5.0))
    assert soft[~mask].max() == 0 and soft[130, 100] == 1


def test_face_oval_of_the_mesh_is_its_rim(data_dir):
    lines = (data_dir / "mediapipe/canonical_face_model.obj").read_text().splitlines()
    faces = [[int(x.split("/")[0]) - 1 for x in s.split()[1:]] for s in lines if s[:2] == "f "]
    count: dict[frozenset, int] = {}
    for a, b, c in faces:
        for edge in ((a, b), (b, c), (c, a)):
            count[frozenset(edge)] = count.get(frozenset(edge), 0) + 1
    border = {edge for edge, n in count.items() if n == 1}
    ring = zip(FACE_OVAL, (*FACE_OVAL[1:], FACE_OVAL[0]), strict=True)
    assert {frozenset(edge) for edge in ring} <= border


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m: dilate(m, -1), "radius is -1"),
        (lambda m: erode(m, -2), "radius is -2"),
        (lambda m: feather(m, -0.5), "width is -0.5"),
        (lambda m: distance_to(m, 0), "limit is 0"),
        (lambda m: face_oval(jnp.zeros((5, 2))), "landmarks has 5 points"),
    ],
)
def test_errors_name_the_argument(call, message):
    with pytest.raises(ValueError, match=message):
        call(jnp.zeros((4, 4), bool))
