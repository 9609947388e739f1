"""Photo -> landmark files and a picture of them."""

import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxface.io.formats.image import write_png
from jaxface.io.formats.landmark_file import Landmarks, write_landmarks
from jaxface.io.pictures.drawing import draw_landmarks
from jaxface.models.landmark_schemes import SCHEME_SIZES, landmarks68
from jaxface.pipeline.photo import open_photo
from jaxface.stages.landmarks import NoFaceError, detect_faces


def write_detections(
    photo: str | os.PathLike[str], out: str | os.PathLike[str], scheme: str = "mediapipe468"
) -> int:
    """Detect every face and write ``landmarks_N.json``, ``.pts`` and ``landmarks.png``.

    Args:
        photo: path, or ``"demo"``.
        out: folder.
        scheme: ``mediapipe468`` or ``ibug68``.

    Returns:
        How many faces there are, largest first.

    Raises:
        NoFaceError: there is none.
        ValueError: an unknown scheme or a file that is no photo.
    """
    if scheme not in SCHEME_SIZES:
        raise ValueError(f"the scheme is {scheme!r}; one of {sorted(SCHEME_SIZES)} is needed")
    pixels = open_photo(photo).pixels
    faces = detect_faces(pixels)
    if not faces:
        raise NoFaceError(f"{photo}: no face found; give points of your own with --landmarks")
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    picture = pixels
    for number, face in enumerate(faces):
        points = np.asarray(face.landmarks)
        if scheme == "ibug68":
            points = np.asarray(landmarks68(jnp.asarray(points)))
        record = Landmarks(points, scheme, (pixels.shape[1], pixels.shape[0]))
        for suffix in ("json", "pts"):
            write_landmarks(folder / f"landmarks_{number}.{suffix}", record)
        picture = draw_landmarks(picture, points)
    write_png(folder / "landmarks.png", picture)
    return len(faces)
