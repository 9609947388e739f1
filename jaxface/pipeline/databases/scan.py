"""A head scan into a model's topology and UVs: landmarks, registration, transfer of its maps."""

import os
from collections.abc import Callable, Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxface.geometry.uv import uv_layout
from jaxface.imaging.colour import srgb_to_linear
from jaxface.io.face_models import load_model
from jaxface.io.formats.image import read_image
from jaxface.io.formats.landmark_file import read_landmarks
from jaxface.io.formats.obj import read_obj
from jaxface.io.texture_database import TextureDatabase
from jaxface.models.morphable import MorphableModel
from jaxface.stages.landmarks import detect_faces
from jaxface.stages.scan._scan_landmarks import scan_landmarks
from jaxface.stages.scan.head_scan import HeadScan
from jaxface.stages.scan.register import RegisteredScan, register_topology
from jaxface.stages.scan.transfer import transfer_texture, whole_texture


def register_scan(
    mesh: str | os.PathLike[str],
    albedo: str | os.PathLike[str] | None = None,
    *,
    model: MorphableModel | None = None,
    landmarks: str | os.PathLike[str] | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> RegisteredScan:
    """Lay a model's topology over a head scan.

    The scan must stand upright and look along +z; its units do not matter.

    Args:
        mesh: OBJ with texture coordinates.
        albedo: the scan's colour map; the detector needs it to find the landmarks.
        model: the topology, by default the bundled model's.
        landmarks: file of 68 or 468 points (x, y, z in the scan's units), instead of detection.
        on_progress: called with (stage, stages) of the registration.

    Raises:
        FileNotFoundError: a file is absent.
        ValueError: the scan has no texture coordinates, or its landmarks cannot be found.
    """
    scan = _head_scan(mesh)
    model = load_model("makehuman") if model is None else model
    if landmarks is not None:
        given = read_landmarks(landmarks)
        if given.points.shape[1] != 3:
            raise ValueError(f"{landmarks} holds points of the plane; x, y, z are needed")
        marks = np.asarray(given.points, np.float64)
    elif albedo is None:
        raise ValueError("finding landmarks needs the scan's albedo (or give a landmark file)")
    else:
        marks = scan_landmarks(scan, read_image(albedo).pixels, detect_faces)
    return register_topology(scan, marks, model, on_progress=on_progress)


def import_scan(
    mesh: str | os.PathLike[str],
    albedo: str | os.PathLike[str],
    out: str | os.PathLike[str],
    resolution: int = 1024,
    *,
    subject: str,
    licence: str,
    landmarks: str | os.PathLike[str] | None = None,
    attributes: Mapping[str, object] | None = None,
    name: str = "scans",
    credits: tuple[str, ...] = (),
    on_progress: Callable[[int, int], None] | None = None,
) -> tuple[TextureDatabase, RegisteredScan]:
    """Register a scan and add its albedo to a database.

    Args:
        mesh: OBJ of a head with texture coordinates.
        albedo: its colour map (sRGB-encoded).
        out: folder of the database, new or begun.
        resolution: texels along a side.
        subject: its name in the database.
        licence: of the scan, with its credit.
        landmarks: see `register_scan`.
        attributes: recorded with the subject.
        name: of a new database.
        credits: lines added to the database's; by default the licence.
        on_progress: called with (stage, stages) of the registration.

    Raises:
        FileNotFoundError: a file is absent.
        ValueError: as `register_scan` and `TextureDatabase.create`.
    """
    model = load_model("makehuman")
    database = TextureDatabase.create(
        out, model, resolution, name=name, licence=licence, credits=credits or (licence,)
    )
    registered = register_scan(
        mesh, albedo, model=model, landmarks=landmarks, on_progress=on_progress
    )
    layout = uv_layout(model.uv, model.uv_faces, resolution)
    linear = np.asarray(srgb_to_linear(jnp.asarray(read_image(albedo).pixels)))
    found = transfer_texture(registered, linear, model, layout)
    texture = np.asarray(whole_texture(found, model, layout))
    record = {"file": Path(albedo).name, **registered.summary(), **dict(attributes or {})}
    database.write_subject(subject, texture, licence=licence, attributes=record)
    return database, registered


def _head_scan(mesh: str | os.PathLike[str]) -> HeadScan:
    scan = read_obj(Path(mesh))
    if scan.uv is None or scan.uv_faces is None:
        raise ValueError("the scan has no texture coordinates; a textured OBJ is needed")
    return HeadScan(scan.vertices, scan.faces, np.asarray(scan.uv), scan.uv_faces)
