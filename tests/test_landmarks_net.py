"""The networks against the reference runtime, their gradients, and the tables of points."""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import skimage.data
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from jaxface.models import landmark_schemes as schemes
from jaxface.networks.landmarks.blaze import depthwise_convolution, read_chain, same_padding
from jaxface.networks.landmarks.face_detector import (
    Candidates,
    FaceDetector,
    anchor_centres,
    overlap,
    suppress,
)
from jaxface.networks.landmarks.face_mesh import (
    LandmarkNet,
    Region,
    landmarks_in_region,
    refine_landmarks,
    region_from_eyes,
    region_from_landmarks,
    rotation_2d,
    symmetric_landmarks,
)
from jaxface.stages.landmarks import bundled_networks

REFERENCES = Path(__file__).parent / "data" / "landmark_references.npz"


@pytest.fixture(scope="module")
def references() -> dict[str, np.ndarray]:
    with np.load(REFERENCES) as arrays:
        return dict(arrays)


@pytest.fixture(scope="module")
def mesh() -> LandmarkNet:
    return bundled_networks().mesh


@pytest.fixture(scope="module")
def detector() -> FaceDetector:
    return bundled_networks().detector


@pytest.fixture(scope="module")
def astronaut() -> np.ndarray:
    return skimage.data.astronaut().astype(np.float32) / 255


def photo_of(name: str, request: pytest.FixtureRequest) -> np.ndarray:
    if name == "portrait":
        path = request.getfixturevalue("data_dir") / "faces" / "obama.jpg"
        if not path.is_file():
            pytest.skip(f"no portrait at {path}")
        return np.asarray(Image.open(path).convert("RGB"))
    if name == "camera":
        return np.repeat(skimage.data.camera()[..., None], 3, axis=2)
    return skimage.data.astronaut()


def region_of(array: np.ndarray) -> Region:
    x, y, side, angle = jnp.asarray(array)
    return Region(jnp.stack([x, y]), side, angle)


@pytest.mark.parametrize("name", ["astronaut", "camera", "portrait"])
def test_points_are_those_of_the_reference_runtime(name, references, mesh, request):
    photo = photo_of(name, request).astype(np.float32) / 255
    region = region_of(references[f"{name}/region"])
    points, presence = eqx.filter_jit(landmarks_in_region)(mesh, photo, region)
    expected = references[f"{name}/points"]
    distance = np.linalg.norm(points[:, :2] - expected[:, :2], axis=1)
    assert distance.mean() < 0.02  # px of the photo
    assert distance.max() < 0.1
    np.testing.assert_allclose(points[:, 2], expected[:, 2], atol=0.1)
    reference = jax.nn.sigmoid(references[f"{name}/presence_logit"])
    np.testing.assert_allclose(presence, reference, atol=1e-3)


def test_detector_outputs_are_those_of_the_reference_runtime(references, detector, astronaut):
    picture = astronaut.reshape(128, 4, 128, 4, 3).mean(axis=(1, 3))
    found = eqx.filter_jit(detector)(picture)
    logits, raw = references["astronaut/detector_logits"], references["astronaut/detector_raw"]
    np.testing.assert_allclose(found.scores, jax.nn.sigmoid(logits), atol=1e-5)
    anchors = np.asarray(anchor_centres())
    centre, size = raw[:, :2] + anchors, raw[:, 2:4]
    expected = np.concatenate([centre - size / 2, centre + size / 2], axis=1)
    np.testing.assert_allclose(found.boxes, expected, atol=1e-3)
    keypoints = raw[:, 4:].reshape(-1, 6, 2) + anchors[:, None]
    np.testing.assert_allclose(found.keypoints, keypoints, atol=1e-3)


def test_anchors_fill_both_grids():
    anchors = np.asarray(anchor_centres())
    assert anchors.shape == (896, 2)
    np.testing.assert_allclose(anchors[:3], [[4, 4], [4, 4], [12, 4]])
    np.testing.assert_allclose(anchors[512], [8, 8])
    np.testing.assert_allclose(anchors[-1], [120, 120])


def test_batches_by_vmap_agree_with_single_crops(mesh):
    crops = jax.random.uniform(jax.random.key(0), (2, 192, 192, 3))
    points, presence = jax.jit(jax.vmap(lambda crop: mesh(crop)))(crops)
    single = jax.jit(lambda crop: mesh(crop))
    for i in range(2):
        one, sure = single(crops[i])
        np.testing.assert_allclose(points[i], one, atol=1e-2)
        np.testing.assert_allclose(presence[i], sure, atol=1e-4)


def test_gradient_with_respect_to_the_image(mesh, astronaut, x64):
    # Noise, for the maximum of equal pixels has no derivative.
    noise = np.random.default_rng(0).normal(size=(170, 180, 3)) * 0.02
    photo = jnp.asarray(astronaut[40:210, 140:320] + noise)
    region = Region(jnp.array([85.0, 83.0]), jnp.array(160.0), jnp.array(0.03))
    weights = jax.random.normal(jax.random.key(1), (468, 3), jnp.float64)

    def value(image):
        return jnp.sum(landmarks_in_region(mesh, image, region)[0] * weights)

    direction = jax.random.normal(jax.random.key(2), photo.shape, jnp.float64)
    step = 1e-7
    jitted = jax.jit(value)
    numeric = (jitted(photo + step * direction) - jitted(photo - step * direction)) / (2 * step)
    _, forward = jax.jit(lambda x, t: jax.jvp(value, (x,), (t,)))(photo, direction)
    gradient = jax.jit(jax.grad(value))(photo)
    assert abs(numeric) > 1e-3
    np.testing.assert_allclose(forward, numeric, rtol=1e-5)
    np.testing.assert_allclose(jnp.sum(gradient * direction), numeric, rtol=1e-5)


def test_symmetric_landmarks_of_a_mirrored_photo_are_mirrored(mesh, astronaut):
    look = eqx.filter_jit(symmetric_landmarks)
    width = astronaut.shape[1]
    region = Region(jnp.array([225.5, 123.0]), jnp.array(160.0), jnp.array(0.05))
    opposite = Region(jnp.array([width - 225.5, 123.0]), jnp.array(160.0), jnp.array(-0.05))
    points, _ = look(mesh, astronaut, region)
    other, _ = look(mesh, astronaut[:, ::-1], opposite)
    unmirrored = np.asarray(other)[np.asarray(mesh.mirror)] * [-1, 1, 1] + [width, 0, 0]
    np.testing.assert_allclose(points, unmirrored, atol=0.05)


def test_refining_from_a_rough_region_comes_to_the_same_points(mesh, astronaut):
    refine = eqx.filter_jit(lambda m, p, r: refine_landmarks(m, p, r, passes=4))
    rough = [
        Region(jnp.array([x, y]), jnp.array(s), jnp.array(0.0))
        for x, y, s in ((215.0, 118.0, 140.0), (233.0, 128.0, 180.0))
    ]
    first, second = (np.asarray(refine(mesh, astronaut, region)[0]) for region in rough)
    assert np.linalg.norm(first[:, :2] - second[:, :2], axis=1).mean() < 1.0
    with pytest.raises(ValueError, match="passes is 0"):
        refine_landmarks(mesh, astronaut, rough[0], passes=0)


def test_region_from_landmarks_turns_with_the_points():
    points = np.random.default_rng(0).normal(size=(468, 3)).astype(np.float32) * 40
    points[33], points[263] = [-30, 0, 0], [30, 0, 0]
    upright = region_from_landmarks(jnp.asarray(points))
    np.testing.assert_allclose(upright.angle, 0, atol=1e-6)
    turned = points.copy()
    turned[:, :2] = points[:, :2] @ np.asarray(rotation_2d(jnp.array(0.7))).T + [200, 100]
    region = region_from_landmarks(jnp.asarray(turned))
    np.testing.assert_allclose(region.angle, 0.7, atol=1e-5)
    np.testing.assert_allclose(region.side, upright.side, rtol=1e-5)
    expected = rotation_2d(jnp.array(0.7)) @ upright.centre + jnp.array([200, 100])
    np.testing.assert_allclose(region.centre, expected, atol=1e-3)


def test_region_transform_maps_the_crop_onto_the_square():
    region = region_from_eyes(
        jnp.array([10.0, 20.0, 50.0, 80.0]), jnp.array([20.0, 40.0]), jnp.array([40.0, 40.0])
    )
    np.testing.assert_allclose(region.side, 90)
    transform = region.transform(10)
    corners = jnp.array([[0, 0, 1], [10, 10, 1], [5, 5, 1]]) @ transform.T
    np.testing.assert_allclose(corners, [[-15, 5], [75, 95], [30, 50]], atol=1e-4)


@given(st.integers(1, 12), st.sampled_from([1, 2]), st.integers(0, 10))
def test_depthwise_convolution_is_the_grouped_convolution(size, stride, seed):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(size + 3, size + 4, 5)).astype(np.float32)
    kernel = rng.normal(size=(3, 3, 5)).astype(np.float32)
    padding = [same_padding(n, 3, stride) for n in x.shape[:2]]
    expected = jax.lax.conv_general_dilated(
        x[None],
        kernel[:, :, None],
        (stride, stride),
        padding,
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        feature_group_count=5,
    )[0]
    found = depthwise_convolution(jnp.asarray(x), jnp.asarray(kernel), stride)
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_suppression_blends_overlapping_boxes_and_keeps_separate_ones():
    boxes = np.array([[0, 0, 10, 10], [2, 0, 12, 10], [50, 50, 60, 60], [51, 50, 50, 60]])
    scores = np.array([0.9, 0.6, 0.8, 0.95])
    keypoints = np.repeat(boxes[:, None, :2], 6, axis=1)
    found = suppress(Candidates(boxes, keypoints, scores))
    assert found.boxes.shape == (2, 4)  # the last box is inside out
    np.testing.assert_allclose(found.boxes[0], [0.8, 0, 10.8, 10])
    np.testing.assert_allclose(found.scores, [0.9, 0.8])
    empty = suppress(Candidates(boxes, keypoints, scores), min_score=0.99)
    assert empty.boxes.shape == (0, 4) and empty.keypoints.shape == (0, 6, 2)


def test_overlap():
    boxes = np.array([[0, 0, 2, 2], [1, 0, 3, 2], [5, 5, 6, 6]], float)
    np.testing.assert_allclose(overlap(boxes[0], boxes), [1, 1 / 3, 0])


def test_reading_absent_weights_names_them():
    with pytest.raises(ValueError, match="no layer nothing/0"):
        read_chain({"a/0/kernel": np.zeros((1, 1, 1, 1))}, "nothing")


def test_mirror_is_an_involution_that_swaps_the_sides(mesh):
    mirror = np.asarray(mesh.mirror)
    np.testing.assert_array_equal(mirror[mirror], np.arange(468))
    assert mirror[33] == 263 and mirror[61] == 291 and mirror[4] == 4
    # Mirrored, the right brow runs the other way round.
    assert {int(mirror[i]) for i in schemes.RIGHT_BROW} == set(schemes.LEFT_BROW)
    assert {int(mirror[i]) for i in schemes.RIGHT_EYE} == set(schemes.LEFT_EYE)
    assert {int(mirror[i]) for i in schemes.FACE_OVAL} == set(schemes.FACE_OVAL)


def test_the_68_points_mirror_as_the_468_do(mesh):
    points = np.random.default_rng(0).normal(size=(468, 2)).astype(np.float32)
    mirrored = points[np.asarray(mesh.mirror)]
    pairs = [*range(16, -1, -1), *range(26, 16, -1), 27, 28, 29, 30, 35, 34, 33, 32, 31]
    pairs += [45, 44, 43, 42, 47, 46, 39, 38, 37, 36, 41, 40]
    pairs += [54, 53, 52, 51, 50, 49, 48, 59, 58, 57, 56, 55, 64, 63, 62, 61, 60, 67, 66, 65]
    found = schemes.landmarks68(jnp.asarray(points))
    other = schemes.landmarks68(jnp.asarray(mirrored))
    np.testing.assert_allclose(found, np.asarray(other)[pairs], atol=1e-6)


def test_68_points_follow_the_table():
    assert schemes.MEDIAPIPE_TO_IBUG68.shape == (68, 2)
    np.testing.assert_allclose(schemes.MEDIAPIPE_TO_IBUG68_WEIGHTS.sum(axis=1), 1)
    points = jnp.arange(468.0)[:, None]
    np.testing.assert_allclose(schemes.landmarks68(points)[36, 0], 33)
    np.testing.assert_allclose(schemes.landmarks68(points)[49, 0], (40 + 39) / 2)


@pytest.mark.parametrize("name", schemes.CONTOURS)
def test_contours_are_clockwise_polygons_on_a_face(name, references):
    points = references["astronaut/points"][list(schemes.CONTOURS[name]), :2]
    assert len(set(schemes.CONTOURS[name])) == len(points)
    following = np.roll(points, -1, axis=0)
    area = np.sum(points[:, 0] * following[:, 1] - points[:, 1] * following[:, 0]) / 2
    assert area > 0  # y points down
