"""From a photo and its landmarks to the input of a fit, on the host."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import Float
from jaxface.imaging.crop import Crop, crop_face
from jaxface.models.face_oval import face_oval_mask
from jaxface.models.landmark_schemes import CONTOURS, INNER_68, MEDIAPIPE_TO_IBUG68
from jaxface.models.parameters import FaceParameters
from jaxface.stages.fit.records import FitInput

OUTER_EYE_CORNERS = {68: (36, 45), 468: (33, 263)}
DEFAULT_FOCAL = 1.4
"""focal length over the photo's longer side if the file does not tell: a 50 mm lens at 35 mm"""

WORKING_SIZE = 512
"""px along a side of the working image, unless another is asked for"""

SMOOTH_SKIN_WEIGHT = 0.1
"""share of the face mesh's points on forehead and cheeks, which no feature of the photo fixes"""


def landmark_weights(count: int) -> Float[np.ndarray, "l"]:
    """How much each landmark counts: those on eyes, brows, nose and lips fully.

    Of the 468 points two thirds lie on smooth skin or the rim, where the detector interpolates:
    they say little and are biased towards its own mean face.
    """
    if count == 68:
        return np.ones(68)
    weights = np.full(count, SMOOTH_SKIN_WEIGHT)
    features = [i for name, line in CONTOURS.items() if name != "face oval" for i in line]
    weights[features] = 1.0
    weights[MEDIAPIPE_TO_IBUG68[INNER_68].reshape(-1)] = 1.0
    return weights


_oval_mask = jax.jit(face_oval_mask, static_argnums=(1, 2))


def input_shapes(size: int, landmarks: int) -> FitInput:
    """Shapes and types of any photo's input for a fit, in place of its arrays.

    Args:
        size: side of the working image, px.
        landmarks: how many points there are.
    """

    def array(*shape: int, dtype: Any = float) -> Any:
        return jax.ShapeDtypeStruct(shape, jnp.result_type(dtype))

    return FitInput(
        image=array(size, size, 3),
        mask=array(size, size),
        landmarks=array(landmarks, 2),
        landmark_weight=array(landmarks),
        landmark_unit=array(),
        principal=array(2),
        log_focal=array(),
        log_focal_deviation=array(),
        estimate_inliers=array(dtype=bool),
    )


class WorkingPhoto(NamedTuple):
    """The fit's input and how it was cut out of the photo.

    Attributes:
        data: input of the fit.
        crop: where the working image lies in the photo.
        gain: the working image is ``gain`` times the photo's linear light.
    """

    data: FitInput
    crop: Crop
    gain: float


def working_photo(
    photo: Float[np.ndarray, "h w 3"],
    landmarks: Float[np.ndarray, "l 2"],
    *,
    mask: Float[np.ndarray, "h w"] | None = None,
    focal: float | None = None,
    size: int = WORKING_SIZE,
    estimate_inliers: bool = True,
    even_landmarks: bool = False,
) -> WorkingPhoto:
    """Cut the face out of a photo and bring it to the fit's scale and exposure.

    Exposure is divided out (median of the face's pixels to 0.5), because the weight of the photo
    term is absolute; the fitted light is in units of the working image.

    Args:
        photo: linear RGB.
        landmarks: (x, y) px: 68 iBUG or 468 MediaPipe points.
        mask: valid face pixels of the photo, trusted as it is; by default the face oval, in
            which hair, hands and glasses are then looked for.
        focal: focal length in px, if known; else a normal lens is the weak prior.
        size: side of the working image, a multiple of 4.
        estimate_inliers: whether hair, hands and glasses are looked for where no mask is given.
        even_landmarks: all landmarks alike, not by what they lie on (``landmark_weights``).

    Raises:
        ValueError: wrong number of landmarks, or a photo, mask or landmarks that do not fit.
    """
    points = np.asarray(landmarks, np.float64)[:, :2]
    if len(points) not in OUTER_EYE_CORNERS:
        raise ValueError(f"{len(points)} landmarks; 68 (iBUG) or 468 (MediaPipe) are needed")
    height, width = photo.shape[:2]
    crop = crop_face(photo, points, size)
    inside = crop.to_crop(points)
    if mask is None:
        valid = np.asarray(_oval_mask(jnp.asarray(inside * size, jnp.float32), size, size))
    else:
        if mask.shape != (height, width):
            raise ValueError(f"the mask is {mask.shape}, but the photo is {(height, width)}")
        shown = np.repeat(np.asarray(mask, np.float32)[..., None], 3, axis=-1)
        valid = crop_face(shown, points, size).image[..., 0]
    valid = valid * crop.inside
    if (valid > 0.5).sum() < 200:
        raise ValueError(
            "the mask leaves fewer than 200 pixels of the face; a mask that is white on skin is "
            "needed"
        )
    level = float(np.median(crop.image[valid > 0.5]))
    if not level > 1e-5:
        raise ValueError("the face is black: there is no light in the photo to fit")
    left, right = OUTER_EYE_CORNERS[len(points)]
    focal_side = (focal if focal is not None else DEFAULT_FOCAL * max(height, width)) / crop.side
    centre = crop.to_crop(np.array([width / 2, height / 2]))
    gain = 0.5 / level

    def array(value):
        return jax.device_put(np.asarray(value, jnp.result_type(float)))

    data = FitInput(
        image=array(crop.image * gain),
        mask=array(valid),
        landmarks=array(inside),
        landmark_weight=array(
            np.ones(len(points)) if even_landmarks else landmark_weights(len(points))
        ),
        landmark_unit=array(np.linalg.norm(inside[left] - inside[right])),
        principal=array(centre),
        log_focal=array(np.log(focal_side)),
        log_focal_deviation=array(0.05 if focal is not None else 0.3),
        estimate_inliers=jnp.asarray(estimate_inliers and mask is None),
    )
    return WorkingPhoto(data, crop, gain)


def in_units_of(working: WorkingPhoto, y: FaceParameters, of: WorkingPhoto) -> FaceParameters:
    """The unknowns of one photo's fit in the units of another photo by the same camera.

    The focal length stays in pixels of the photo, the light in the photo's own linear values, and
    the head where it is before the camera.

    Args:
        working: the other photo.
        y: unknowns of the fit.
        of: the photo that was fitted.
    """
    closer = float(np.log(of.crop.side / working.crop.side))
    brighter = float(working.gain / of.gain)
    converted = (y.log_focal + closer, y.light * brighter)
    return eqx.tree_at(lambda p: (p.log_focal, p.light), y, converted)
