"""Two sets of facial points, the 468 of MediaPipe's face mesh and the 68 of iBUG, and their parts.

The 68 points (Sagonas et al., "300 Faces in-the-Wild Challenge", 2013; the order of Multi-PIE and
dlib) start at the subject's right ear: 0-16 jaw, 17-26 brows, 27-35 nose, 36-47 eyes, 48-67 mouth.
Right and left are the subject's.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Float

SCHEME_SIZES = {"ibug68": 68, "mediapipe468": 468}
"""number of points of each scheme"""

FACE_OVAL = (
    *(10, 338, 297, 332, 284, 251, 389, 356, 454, 323, 361, 288, 397, 365, 379, 378, 400, 377),
    *(152, 148, 176, 149, 150, 136, 172, 58, 132, 93, 234, 127, 162, 21, 54, 103, 67, 109),
)
"""The rim of the 468-point MediaPipe face mesh, in order from the middle of the hairline."""
"""outline of the face (of the 468), clockwise as seen from the top"""
JAW_68 = range(0, 17)
"""of the 68: the contour, which moves over the surface as the head turns"""
INNER_68 = range(17, 68)
"""of the 68: the points that stay where they are on the face"""

# fmt: off
_PAIRS = (
    # jaw: even steps along the lower face oval
    (127, 234, 1), (234, 93, .70), (93, 132, .44), (132, 58, .29), (58, 172, .16), (136, 150, .95),
    (150, 149, .57), (176, 148, .82), (152, 152, 1), (400, 377, .82), (378, 379, .43),
    (379, 365, .05), (397, 288, .84), (288, 361, .71), (361, 323, .56), (323, 454, .30),
    (356, 356, 1),
    # brows, outer to inner and inner to outer: between the upper edge and the middle
    (70, 46, .75), (63, 53, .75), (105, 52, .75), (66, 65, .75), (107, 55, .75),
    (336, 285, .75), (296, 295, .75), (334, 282, .75), (293, 283, .75), (300, 276, .75),
    # nose: ridge, then underside from the subject's right
    (168, 168, 1), (6, 197, .30), (195, 5, .40), (4, 1, .50),
    (98, 98, 1), (97, 97, 1), (2, 2, 1), (326, 326, 1), (327, 327, 1),
    # eyes, clockwise as seen, from the left of the picture
    (33, 33, 1), (160, 160, 1), (158, 158, 1), (133, 133, 1), (153, 153, 1), (144, 144, 1),
    (362, 362, 1), (385, 385, 1), (387, 387, 1), (263, 263, 1), (373, 373, 1), (380, 380, 1),
    # mouth: outer edge, then inner edge, both clockwise as seen
    (61, 61, 1), (40, 39, .50), (37, 37, 1), (0, 0, 1), (267, 267, 1), (269, 270, .50),
    (291, 291, 1), (321, 405, .50), (314, 314, 1), (17, 17, 1), (84, 84, 1), (91, 181, .50),
    (78, 78, 1), (81, 82, .50), (13, 13, 1), (312, 311, .50),
    (308, 308, 1), (317, 402, .50), (14, 14, 1), (87, 178, .50),
)

LIPS_OUTER = (
    61, 185, 40, 39, 37, 0, 267, 269, 270, 409, 291, 375, 321, 405, 314, 17, 84, 181, 91, 146,
)
LIPS_INNER = (
    78, 191, 80, 81, 82, 13, 312, 311, 310, 415, 308, 324, 318, 402, 317, 14, 87, 178, 88, 95,
)
RIGHT_EYE = (33, 246, 161, 160, 159, 158, 157, 173, 133, 155, 154, 153, 145, 144, 163, 7)
LEFT_EYE = (362, 398, 384, 385, 386, 387, 388, 466, 263, 249, 390, 373, 374, 380, 381, 382)
RIGHT_BROW = (70, 63, 105, 66, 107, 55, 65, 52, 53, 46)
LEFT_BROW = (336, 296, 334, 293, 300, 276, 283, 282, 295, 285)
NOSE_RIDGE = (168, 6, 197, 195, 5, 4, 1, 19, 94, 2)
# fmt: on

CONTOURS = {
    "face oval": FACE_OVAL,
    "right brow": RIGHT_BROW,
    "left brow": LEFT_BROW,
    "right eye": RIGHT_EYE,
    "left eye": LEFT_EYE,
    "outer lips": LIPS_OUTER,
    "inner lips": LIPS_INNER,
}
"""closed polygons of the 468, clockwise as seen in the picture, by name"""

CONTOURS_68 = {
    "jaw": (range(0, 17), False),
    "right brow": (range(17, 22), False),
    "left brow": (range(22, 27), False),
    "nose ridge": (range(27, 31), False),
    "nose underside": (range(31, 36), False),
    "right eye": (range(36, 42), True),
    "left eye": (range(42, 48), True),
    "outer lips": (range(48, 60), True),
    "inner lips": (range(60, 68), True),
}
"""lines through the 68 by name, and whether each is closed"""

MEDIAPIPE_TO_IBUG68 = np.array([(first, second) for first, second, _ in _PAIRS], np.int32)
"""(68, 2) the two of the 468 between which each of the 68 lies"""

MEDIAPIPE_TO_IBUG68_WEIGHTS = np.array([(share, 1 - share) for _, _, share in _PAIRS], np.float32)
"""(68, 2) the weight of each of the two"""


@functools.partial(jax.jit, inline=True)
def landmarks68(points: Float[Array | np.ndarray, "468 d"]) -> Float[Array, "68 d"]:
    """The 68 iBUG points of a face mesh: fixed blends of two mesh points each.

    The 17 of the jaw come from the mesh's own outline, not from the visible silhouette.
    """
    points = jnp.asarray(points)
    weights = jnp.asarray(MEDIAPIPE_TO_IBUG68_WEIGHTS, points.dtype)
    return jnp.einsum("lpd,lp->ld", points[MEDIAPIPE_TO_IBUG68], weights)
