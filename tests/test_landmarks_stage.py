"""Faces in photos: found at any size and turn, told apart, counted, and refused."""

from pathlib import Path

import numpy as np
import pytest
import skimage.data
from PIL import Image

from jaxface.models.landmark_schemes import FACE_OVAL, INNER_68, landmarks68
from jaxface.stages.landmarks import (
    DetectedFace,
    NoFaceError,
    SeveralFacesError,
    detect_faces,
    detect_one,
)

PHOTO = skimage.data.astronaut()
EYES_APART = 62.4  # px, outer corners
REFERENCES = Path(__file__).parent / "data" / "landmark_references.npz"


@pytest.fixture(scope="module")
def upright() -> DetectedFace:
    return detect_one(PHOTO)


def error_of(face: DetectedFace, expected: np.ndarray, eyes_apart: float = EYES_APART) -> float:
    """Mean distance to the expected points in the image, share of the distance of the eyes."""
    distance = np.linalg.norm(face.landmarks[:, :2] - expected[:, :2], axis=1)
    return float(distance.mean() / eyes_apart)


def test_astronaut_against_the_reference_pipeline(upright):
    with np.load(REFERENCES) as arrays:
        reference = arrays["astronaut/tracked"]
    assert upright.score > 0.8 and upright.presence > 0.9
    assert error_of(upright, reference) < 0.02
    assert np.linalg.norm(upright.landmarks[:, :2] - reference[:, :2], axis=1).mean() < 1.0  # px
    # Depth is up to a constant; the tip of the nose is nearer than the ears.
    depth = upright.landmarks[:, 2] - upright.landmarks[:, 2].mean()
    np.testing.assert_allclose(depth, reference[:, 2] - reference[:, 2].mean(), atol=4.0)
    assert upright.landmarks[4, 2] < upright.landmarks[234, 2] - 20


def test_the_box_bounds_the_points(upright):
    points = upright.landmarks[:, :2]
    np.testing.assert_allclose(upright.box[:2], points.min(axis=0))
    np.testing.assert_allclose(upright.box[2:], points.max(axis=0))
    np.testing.assert_allclose(upright.size, max(upright.box[2:] - upright.box[:2]))


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_quarter_turns(upright, turns):
    face = detect_one(np.ascontiguousarray(np.rot90(PHOTO, turns)))
    expected = upright.landmarks[:, :2]
    for _ in range(turns):
        expected = np.stack([expected[:, 1], 512 - expected[:, 0]], axis=1)
    assert error_of(face, expected) < 0.01


@pytest.mark.parametrize("degrees", [-40, 30, 135])
def test_tilted_heads(upright, degrees):
    tilted = np.asarray(Image.fromarray(PHOTO).rotate(degrees, Image.Resampling.BICUBIC))
    angle = np.deg2rad(degrees)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    expected = (upright.landmarks[:, :2] - 256) @ turn.T + 256
    assert error_of(detect_one(tilted), expected) < 0.015


def test_a_mirrored_photo_gives_mirrored_points(upright):
    from jaxface.stages.landmarks import bundled_networks

    face = detect_one(PHOTO[:, ::-1])
    mirror = np.asarray(bundled_networks().mesh.mirror)
    expected = upright.landmarks[mirror, :2] * [-1, 1] + [512, 0]
    assert error_of(face, expected) < 0.01


@pytest.mark.parametrize("width", [160, 300, 1400])
def test_other_sizes(upright, width):
    resized = np.asarray(Image.fromarray(PHOTO).resize((width, width), Image.Resampling.LANCZOS))
    scale = width / 512
    error = error_of(detect_one(resized), upright.landmarks * scale, EYES_APART * scale)
    assert error < (0.03 if width < 200 else 0.015)


def test_a_small_face_in_a_large_photo(upright):
    small = np.asarray(Image.fromarray(PHOTO).resize((215, 215), Image.Resampling.LANCZOS))
    photo = np.full((1500, 2000, 3), 90, np.uint8)
    photo[1100:1315, 1500:1715] = small
    (face,) = detect_faces(photo)
    assert 35 < face.size < 50
    scale = 215 / 512
    expected = upright.landmarks[:, :2] * scale + [1500, 1100]
    assert error_of(face, expected, EYES_APART * scale) < 0.03


def test_grey_float_and_faint_photos_give_the_same_points(upright):
    as_float = (PHOTO / 255).astype(np.float64)
    np.testing.assert_allclose(detect_one(as_float).landmarks, upright.landmarks, atol=0.02)
    grey = np.repeat(PHOTO.mean(axis=2, keepdims=True) / 255, 3, axis=2)
    assert error_of(detect_one(grey), upright.landmarks) < 0.03
    faint = 0.15 + 0.4 * as_float
    assert error_of(detect_one(faint), upright.landmarks) < 0.03


def test_every_face_is_found_and_the_largest_comes_first(upright):
    half = np.asarray(Image.fromarray(PHOTO).resize((256, 256), Image.Resampling.LANCZOS))
    photo = np.zeros((512, 1024, 3), np.uint8)
    photo[:256, 20:276], photo[:, 512:] = half, PHOTO
    large, small = detect_faces(photo, smallest=40)
    assert large.size > 1.5 * small.size
    assert error_of(large, upright.landmarks + [512, 0, 0]) < 0.015
    assert error_of(small, upright.landmarks / 2 + [20, 0, 0], EYES_APART / 2) < 0.03
    with pytest.raises(SeveralFacesError, match=r"2 faces .* \(0: 9.x10. px at .*; 1: .*--face N"):
        detect_one(np.tile(PHOTO, (1, 2, 1)))
    with pytest.raises(ValueError, match="face 2 is asked for, but the photo has 2"):
        detect_one(np.tile(PHOTO, (1, 2, 1)), index=2)
    face = detect_one(np.tile(PHOTO, (1, 2, 1)), index=1)
    assert face.size > 90


@pytest.mark.parametrize("name", ["chelsea", "coffee", "noise"])
def test_no_face(name):
    noise = np.random.default_rng(0).integers(0, 256, (200, 300, 3), np.uint8)
    photo = noise if name == "noise" else getattr(skimage.data, name)()
    assert detect_faces(photo) == []
    if name == "noise":
        with pytest.raises(NoFaceError, match="300x200 px; one is needed"):
            detect_one(photo)


def test_arrays_that_are_no_photos_are_refused():
    with pytest.raises(ValueError, match="shape"):
        detect_faces(np.zeros((50, 50)))
    with pytest.raises(ValueError, match="NaN"):
        detect_faces(np.full((50, 50, 3), np.nan))


def test_portrait(data_dir):
    path = data_dir / "faces" / "obama.jpg"
    if not path.is_file():
        pytest.skip(f"no portrait at {path}")
    face = detect_one(np.asarray(Image.open(path).convert("RGB")))
    with np.load(REFERENCES) as arrays:
        reference = arrays["portrait/points"]
    assert error_of(face, reference, eyes_apart=151.0) < 0.02
    inner = np.asarray(landmarks68(face.landmarks))[list(INNER_68)]
    oval = face.landmarks[list(FACE_OVAL), :2]
    assert np.all(inner[:, :2] > oval.min(axis=0)) and np.all(inner[:, :2] < oval.max(axis=0))


def test_enlarged_25_pixel_faces():
    # Half of the pictures are faces, seen from many sides; none of the rest may pass for one.
    pictures = skimage.data.lfw_subset()
    found = []
    for index in (0, 6, 12, 42, 66, 90, 110, 130, 150, 170):
        photo = np.full((300, 300, 3), 0.45)
        enlarged = Image.fromarray((pictures[index] * 255).astype(np.uint8)).resize((150, 150))
        photo[75:225, 75:225] = np.asarray(enlarged)[..., None] / 255
        found.append(len(detect_faces(photo)))
    assert sum(found[:6]) >= 5 and max(found[:6]) == 1
    assert sum(found[6:]) == 0
