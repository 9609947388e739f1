"""BlazeFace, short range: boxes and six key points of the faces in a 128x128 picture.

Bazarevsky et al., "BlazeFace: Sub-millisecond Neural Face Detection on Mobile GPUs", 2019.
Weights: MediaPipe (Apache-2.0).
"""

from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Float
from jaxface.networks.landmarks.blaze import Convolution, ResidualBlock, chain, read_chain

DETECTOR_SIZE = 128
"""side of the detector's input, px"""

KEYPOINTS = ("right eye", "left eye", "nose tip", "mouth", "right ear", "left ear")
"""the subject's right and left"""

# Two anchors in each cell of the 16x16 map, six in each of the 8x8 map.
_ANCHOR_GRIDS = ((16, 2), (8, 6))


class Candidates(eqx.Module):
    """What the detector says at each anchor, best first after ``suppress``."""

    boxes: Float[Array | np.ndarray, "n 4"]
    """left, top, right, bottom, px"""
    keypoints: Float[Array | np.ndarray, "n 6 2"]
    """see ``KEYPOINTS``; x, y px"""
    scores: Float[Array | np.ndarray, "n"]
    """probability of a face"""


class FaceDetector(eqx.Module):
    """The network: a trunk, and heads on its 16x16 and 8x8 feature maps."""

    fine: tuple[Convolution | ResidualBlock, ...]
    coarse: tuple[Convolution | ResidualBlock, ...]
    score_heads: tuple[Convolution | ResidualBlock, ...]
    box_heads: tuple[Convolution | ResidualBlock, ...]

    def __call__(self, picture: Float[Array | np.ndarray, "128 128 3"]) -> Candidates:
        """All 896 anchors' boxes (px of the picture) and scores; sRGB-encoded RGB in [0, 1]."""
        fine = chain(self.fine, 2 * jnp.asarray(picture) - 1)
        maps = (fine, chain(self.coarse, fine))
        logits = [head(x).reshape(-1) for head, x in zip(self.score_heads, maps, strict=True)]
        raw = [head(x).reshape(-1, 8, 2) for head, x in zip(self.box_heads, maps, strict=True)]
        offsets, anchors = jnp.concatenate(raw), anchor_centres()
        centre, half = offsets[:, 0] + anchors, offsets[:, 1] / 2
        return Candidates(
            jnp.concatenate([centre - half, centre + half], axis=1),
            offsets[:, 2:] + anchors[:, None],
            jax.nn.sigmoid(jnp.concatenate(logits)),
        )


def anchor_centres() -> Float[Array, "896 2"]:
    """Centre (x, y px) of each anchor, in the order of the network's outputs."""
    grids = []
    for cells, count in _ANCHOR_GRIDS:
        axis = (np.arange(cells) + 0.5) * (DETECTOR_SIZE / cells)
        x, y = np.meshgrid(axis, axis)
        grids.append(np.repeat(np.stack([x.ravel(), y.ravel()], axis=1), count, axis=0))
    return jnp.asarray(np.concatenate(grids), jnp.float32)


def read_face_detector(arrays: Mapping[str, np.ndarray]) -> FaceDetector:
    """The detector from its named weights (float32)."""
    return FaceDetector(
        fine=read_chain(arrays, "detector/fine", halving=(0, 3, 6)),
        coarse=read_chain(arrays, "detector/coarse", halving=(0,)),
        score_heads=read_chain(arrays, "detector/score_heads", linear=(0, 1)),
        box_heads=read_chain(arrays, "detector/box_heads", linear=(0, 1)),
    )


def suppress(
    candidates: Candidates, min_score: float = 0.5, max_overlap: float = 0.3
) -> Candidates:
    """One candidate for each face: the score-weighted mean of those that overlap (NumPy).

    BlazeFace, section 3.4: blending the overlapping boxes, rather than dropping all but the best,
    is what keeps a detection from jittering. The score is that of the best.

    Args:
        candidates: any number of them, in one picture's pixels.
        min_score: candidates below are ignored.
        max_overlap: intersection over union above which two boxes are the same face.
    """
    boxes, keypoints, scores = (
        np.asarray(x, np.float64)
        for x in (candidates.boxes, candidates.keypoints, candidates.scores)
    )
    order = np.argsort(-scores, kind="stable")
    solid = np.all(boxes[:, 2:] > boxes[:, :2], axis=1)
    remaining = order[(scores[order] >= min_score) & solid[order]]
    kept = []
    while len(remaining):
        same = overlap(boxes[remaining[0]], boxes[remaining]) > max_overlap
        group = remaining[same]
        weight = scores[group] / scores[group].sum()
        kept.append(
            (weight @ boxes[group], np.tensordot(weight, keypoints[group], 1), scores[group[0]])
        )
        remaining = remaining[~same]
    return Candidates(
        np.array([box for box, _, _ in kept]).reshape(-1, 4),
        np.array([points for _, points, _ in kept]).reshape(-1, 6, 2),
        np.array([score for _, _, score in kept]),
    )


def overlap(box: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Intersection over union of one box with each of several (left, top, right, bottom)."""
    low = np.maximum(box[:2], boxes[:, :2])
    high = np.minimum(box[2:], boxes[:, 2:])
    shared = np.prod(np.maximum(high - low, 0), axis=1)
    area = np.prod(box[2:] - box[:2]) + np.prod(boxes[:, 2:] - boxes[:, :2], axis=1)
    return shared / np.maximum(area - shared, np.finfo(float).tiny)
