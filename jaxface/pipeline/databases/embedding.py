"""Landmark correspondences of a new topology, by the bundled detector."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxface._types import Float
from jaxface.io.face_models import load_model
from jaxface.io.face_models.model_file import save_model
from jaxface.io.formats.image import write_png
from jaxface.io.pictures.drawing import draw_landmarks
from jaxface.io.pictures.overlay import contact_sheet
from jaxface.models.morphable import MorphableModel
from jaxface.stages.landmarks import detect_faces
from jaxface.stages.scan import _embed_landmarks as stage
from jaxface.stages.scan._embed_landmarks import YAWS, Embedding, Look, with_landmarks


def embed_landmarks(model: MorphableModel, yaws: Sequence[float] = YAWS) -> Embedding:
    """`jaxface.stages.embed_landmarks` with the bundled detector.

    Raises:
        ValueError: the detector finds a face in fewer than two views.
    """
    return stage.embed_landmarks(model, detect_faces, yaws)


def embed_landmarks_of(source: str, out: str | os.PathLike[str]) -> dict[str, Any]:
    """Load a model, find its landmarks, and write ``model.npz`` and ``landmarks.png``.

    Raises:
        ValueError: as ``load_model`` and ``embed_landmarks``.
    """
    model = load_model(source)
    found = embed_landmarks(model)
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    save_model(folder / "model.npz", with_landmarks(model, found.points))
    panels = [(f"yaw {look.yaw:.0f}", _drawn(look)) for look in found.looks]
    sheet = contact_sheet(panels, columns=len(panels), cell=420, heading=model.name)
    write_png(folder / "landmarks.png", sheet)
    return {"views": found.views, "median_spread_mm": float(np.median(found.spread))}


def _drawn(look: Look) -> Float[np.ndarray, "h w 3"]:
    if look.landmarks is None:
        return look.picture
    return draw_landmarks(look.picture, look.landmarks)
