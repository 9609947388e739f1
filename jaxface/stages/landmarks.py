"""Photo -> faces: where they are, and 468 points on each."""

import functools
from importlib import resources

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxface._compilation import quick_jit
from jaxface._types import Array, Float, Shaped
from jaxface.imaging.pyramid import halve
from jaxface.imaging.resample import affine_crop
from jaxface.imaging.windows import PhotoPyramid, tile_corners, unturn
from jaxface.networks.landmarks.face_detector import (
    DETECTOR_SIZE,
    Candidates,
    FaceDetector,
    overlap,
    read_face_detector,
    suppress,
)
from jaxface.networks.landmarks.face_mesh import (
    LandmarkNet,
    Region,
    read_landmark_net,
    region_from_eyes,
    region_from_landmarks,
    symmetric_landmarks,
)

SMALLEST_FACE = 40.0
"""px; narrower faces are not looked for unless asked"""

# The detector finds faces wider than this share of its picture. Tiles overlap by twice as much,
# so that any face is whole in one of them until the next coarser tiles can see it.
_FACE_SHARE = 0.16
_TILE_OVERLAP = 2 * _FACE_SHARE
# Turned photos are tried on the whole and on tiles down to a quarter, where they are few.
_TURNED_SCALES = 3
# The pixels that a face is read from: they hold its region at any angle, and room to move it.
_PATCH_SIZE = 640
_REACH = 0.95
# Looks at a face at most, and the move of its region (share of the side) that ends them.
_MAX_LOOKS = 5
_STILL = 0.02
_OTHER_SIZES = (0.92, 1.08)
# The second opinion on a face: side of the picture over that of the landmarks' region, how far
# from its middle (px) a detection counts, and the score below which other turns are tried.
_LEVEL_MARGIN = 4 / 3
_CENTRAL = 20.0
_SURE_SCORE = 0.8


class NoFaceError(ValueError):
    """A face is needed and none was found."""


class SeveralFacesError(ValueError):
    """One face is needed and several were found."""


class DetectedFace(eqx.Module):
    """One face in a photo, in the photo's pixels."""

    box: Float[np.ndarray, "4"]
    """left, top, right, bottom of the landmarks, px"""
    score: float
    """the detector's probability for the face seen level"""
    landmarks: Float[np.ndarray, "468 3"]
    """MediaPipe face mesh: x, y (px) and relative depth (px, larger is farther)"""
    presence: float
    """the landmark network's probability that this is a face"""

    @property
    def size(self) -> float:
        """Longer side of the box, px."""
        return float(np.max(self.box[2:] - self.box[:2]))


class LandmarkNetworks(eqx.Module):
    """The two networks that find faces and their landmarks."""

    detector: FaceDetector
    mesh: LandmarkNet


@functools.cache
def bundled_networks() -> LandmarkNetworks:
    """The networks that come with the package (MediaPipe, Apache-2.0)."""
    path = resources.files("jaxface") / "assets" / "landmark_weights.npz"
    with resources.as_file(path) as file, np.load(file) as arrays:
        weights = dict(arrays)
    return LandmarkNetworks(read_face_detector(weights), read_landmark_net(weights))


def detect_faces(
    image: Shaped[np.ndarray, "h w 3"],
    *,
    networks: LandmarkNetworks | None = None,
    smallest: float | None = None,
    min_score: float = 0.5,
    min_presence: float = 0.5,
) -> list[DetectedFace]:
    """Find the faces in a photo and their landmarks, largest first.

    The whole photo is looked at first, then overlapping tiles of half its size, a quarter and so
    on, upright and turned by quarter turns, until a face is found. The landmark network then
    looks at each face twice, the second time in the region that its own points give.

    Args:
        image: sRGB-encoded, ``uint8`` or float in [0, 1].
        networks: the weights; those of the package by default.
        smallest: look down to faces of this width (px) even when larger ones have been found.
            By default stop at the first scale with a face, and at ``SMALLEST_FACE`` px.
        min_score: detections of a lower score are dropped.
        min_presence: faces of a lower presence are dropped.

    Raises:
        ValueError: the array is not a photo (shape, type, size, NaN).
    """
    nets = bundled_networks() if networks is None else networks
    photo = PhotoPyramid(np.asarray(image))
    faces: list[DetectedFace] = []
    for depth, side in enumerate(_tile_sides(max(photo.size), smallest or SMALLEST_FACE)):
        for turns in (0, 1, 3, 2) if depth < _TURNED_SCALES else (0,):
            found = suppress(_candidates(nets, photo, side, turns, min_score), min_score)
            for box, keypoints in zip(found.boxes, found.keypoints, strict=True):
                face = _landmarks(nets, photo, box, keypoints)
                sure = face.score >= min_score and face.presence >= min_presence
                if sure and _is_new(face, faces):
                    faces.append(face)
            if faces:
                break
        # Faces near the limit of this scale may have neighbours just beyond it.
        if smallest is None and any(face.size > _FACE_SHARE * side for face in faces):
            break
    return sorted(faces, key=lambda face: -face.size)


def detect_one(
    image: Shaped[np.ndarray, "h w 3"],
    index: int | None = None,
    *,
    networks: LandmarkNetworks | None = None,
) -> DetectedFace:
    """The only face in a photo, or the one numbered ``index`` from the largest (0).

    Raises:
        NoFaceError: there is none.
        SeveralFacesError: there are several and ``index`` is not given.
        ValueError: there is no face of that number, or the array is not a photo.
    """
    faces = detect_faces(image, networks=networks)
    if not faces:
        height, width = image.shape[:2]
        raise NoFaceError(
            f"no face was found in the photo of {width}x{height} px; one is needed, at least "
            f"{SMALLEST_FACE:.0f} px wide and seen from the front or half from the side. "
            "Landmarks made elsewhere can be given as a file instead"
        )
    listing = "; ".join(
        f"{i}: {face.box[2] - face.box[0]:.0f}x{face.box[3] - face.box[1]:.0f} px at "
        f"({face.box[0]:.0f}, {face.box[1]:.0f})"
        for i, face in enumerate(faces)
    )
    if index is None:
        if len(faces) > 1:
            raise SeveralFacesError(
                f"{len(faces)} faces were found where one is needed ({listing}); choose one by "
                "its number with --face N (index=N)"
            )
        return faces[0]
    if not 0 <= index < len(faces):
        raise ValueError(f"face {index} is asked for, but the photo has {len(faces)} ({listing})")
    return faces[index]


def _tile_sides(longest: float, smallest: float) -> list[float]:
    # Each scale sees faces down to _FACE_SHARE of its side.
    sides = [float(longest)]
    while sides[-1] * _FACE_SHARE > smallest:
        sides.append(sides[-1] / 2)
    return sides


def _candidates(
    nets: LandmarkNetworks, photo: PhotoPyramid, side: float, turns: int, min_score: float
) -> Candidates:
    # Detections in every tile of one scale, in the photo's pixels.
    width, height = photo.size
    scale = side / DETECTOR_SIZE
    boxes, keypoints, scores = [], [], []
    for corner in tile_corners(width, height, side, _TILE_OVERLAP):
        picture = np.rot90(photo.picture(corner, side, DETECTOR_SIZE), turns)
        found = jax.tree.map(np.asarray, _detect(nets.detector, picture))
        good = found.scores >= min_score
        points = np.concatenate([found.boxes[good].reshape(-1, 2, 2), found.keypoints[good]], 1)
        points = np.array(corner) + scale * unturn(points, turns, DETECTOR_SIZE)
        low, high = points[:, :2].min(axis=1), points[:, :2].max(axis=1)
        boxes.append(np.concatenate([low, high], axis=1))
        keypoints.append(points[:, 2:])
        scores.append(found.scores[good])
    return Candidates(np.concatenate(boxes), np.concatenate(keypoints), np.concatenate(scores))


def _landmarks(
    nets: LandmarkNetworks, photo: PhotoPyramid, box: np.ndarray, keypoints: np.ndarray
) -> DetectedFace:
    region = _first_region(*(np.asarray(x, np.float32) for x in (box, *keypoints[:2])))
    # In NumPy from here: every operation of JAX's own would be compiled for itself.
    region = jax.tree.map(np.asarray, region)
    centre = (float(region.centre[0]), float(region.centre[1]))
    patch, corner, factor = photo.patch(centre, _REACH * float(region.side), _PATCH_SIZE)
    image = _channels_last(patch)
    local = Region(region.centre / factor - corner, region.side / factor, region.angle)
    points, presence, local = _settle(nets.mesh, image, local)
    # The mesh is sure of itself upside down and on blobs. A face seen level convinces the
    # detector, and more so than any other turn of it does.
    level = _level_picture(image, local)
    scores = [_central_score(nets.detector, level)]
    if scores[0] < _SURE_SCORE:
        scores += [_central_score(nets.detector, np.rot90(level, turns)) for turns in (1, 2, 3)]
    turns = int(np.argmax(scores))
    if turns:
        turned = Region(local.centre, local.side, local.angle + np.float32(turns * np.pi / 2))
        points, presence, _ = _settle(nets.mesh, image, turned)
    landmarks = ((points + np.append(corner, 0)) * factor).astype(np.float32)
    low, high = landmarks[:, :2].min(axis=0), landmarks[:, :2].max(axis=0)
    return DetectedFace(np.concatenate([low, high]), scores[turns], landmarks, presence)


def _settle(
    mesh: LandmarkNet, image: Float[Array, "p p 3"], region: Region
) -> tuple[np.ndarray, float, Region]:
    # Look until the region that the points give is the one they were found in. A detection's
    # region is rough, so the first look never counts. Then average over a few sizes of it.
    def look(region: Region) -> tuple[np.ndarray, np.ndarray, Region]:
        return jax.tree.map(np.asarray, _look(mesh, image, region))

    _, _, region = look(region)
    for _ in range(_MAX_LOOKS - 1):
        before = region
        points, presence, region = look(before)
        shift = np.max(np.abs(region.centre - before.centre))
        if max(shift, abs(region.side - before.side)) < _STILL * region.side:
            break
    others = [
        look(Region(before.centre, before.side * np.float32(k), before.angle))[0]
        for k in _OTHER_SIZES
    ]
    return np.mean([points, *others], axis=0), float(presence), region


def _central_score(detector: FaceDetector, picture: Float[np.ndarray, "128 128 3"]) -> float:
    # The best score among the boxes that are about the middle.
    found = jax.tree.map(np.asarray, _detect(detector, picture))
    away = (found.boxes[:, :2] + found.boxes[:, 2:]) / 2 - DETECTOR_SIZE / 2
    central = np.max(np.abs(away), axis=1) < _CENTRAL
    return float(np.max(found.scores * central))


def _is_new(face: DetectedFace, faces: list[DetectedFace]) -> bool:
    return not faces or bool(np.all(overlap(face.box, np.array([f.box for f in faces])) < 0.3))


_first_region = jax.jit(region_from_eyes)


@jax.jit
def _channels_last(patch: Float[np.ndarray, "3 p p"]) -> Float[Array, "p p 3"]:
    return jnp.moveaxis(patch, 0, -1)


@quick_jit
def _detect(detector: FaceDetector, picture: Float[np.ndarray, "128 128 3"]) -> Candidates:
    return detector(picture)


@quick_jit
def _level_picture(image: Float[Array, "p p 3"], region: Region) -> Array:
    wider = Region(region.centre, region.side * _LEVEL_MARGIN, region.angle)
    size = 2 * DETECTOR_SIZE
    return halve(affine_crop(image, wider.transform(size), size, size))


@quick_jit
def _look(
    mesh: LandmarkNet, image: Float[Array, "p p 3"], region: Region
) -> tuple[Float[Array, "468 3"], Float[Array, ""], Region]:
    # Points, presence, and the region to look at next.
    landmarks, presence = symmetric_landmarks(mesh, image, region)
    return landmarks, presence, region_from_landmarks(landmarks)
