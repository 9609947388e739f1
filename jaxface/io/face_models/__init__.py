"""Models of the user's own: each format's loader gives a `MorphableModel`."""

from jaxface.io.face_models.assemble import ModelFormatError
from jaxface.io.face_models.bfm import load_bfm2009, load_bfm_h5
from jaxface.io.face_models.flame import load_flame
from jaxface.io.face_models.ict import load_ict
from jaxface.io.face_models.landmarks import read_landmarks68
from jaxface.io.face_models.registry import describe, load_model
from jaxface.io.face_models.surrey import load_surrey

__all__ = [
    "ModelFormatError",
    "describe",
    "load_bfm2009",
    "load_bfm_h5",
    "load_flame",
    "load_ict",
    "load_model",
    "load_surrey",
    "read_landmarks68",
]
