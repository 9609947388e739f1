"""The outline of a face in a picture, from its landmarks."""

import jax.numpy as jnp

from jaxface._types import Array, Float, Shaped
from jaxface.imaging.masks import feather, fill_polygon
from jaxface.models.landmark_schemes import FACE_OVAL


def face_oval(landmarks: Float[Array, "l 2"], forehead: float = 0.35) -> Float[Array, "k 2"]:
    """Polygon around the face from 468 (or 478) or 68 landmarks, pixels.

    The 68 points end at the eyebrows: there, the brows pushed away from the chin by ``forehead``
    times the height from chin to brows stand for the hairline.

    Raises:
        ValueError: the number of landmarks is not 68, 468 or 478.
    """
    count = landmarks.shape[0]
    if count in (468, 478):
        return landmarks[jnp.array(FACE_OVAL)]
    if count != 68:
        raise ValueError(f"landmarks has {count} points; it needs 68, 468 or 478")
    jaw, brows = landmarks[:17], landmarks[17:27]
    up = jnp.mean(brows, axis=0) - jaw[8]
    # Highest in the middle of the forehead, lower towards the temples.
    arch = jnp.sin(jnp.linspace(0.15, 0.85, 10, dtype=landmarks.dtype) * jnp.pi)[:, None]
    return jnp.concatenate([jaw, (brows + forehead * arch * up)[::-1]])


def face_oval_mask(
    landmarks: Float[Array, "l 2"], height: int, width: int, soft: float = 0.0
) -> Shaped[Array, "h w"]:
    """Filled face oval; with ``soft`` > 0 its edge rises over that many pixels, inwards."""
    inside = fill_polygon(face_oval(landmarks), height, width)
    return feather(inside, soft) if soft > 0 else inside
