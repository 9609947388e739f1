"""Textures that exist already, brought into a database: MakeHuman skins, and a scan of a head."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from jaxface.geometry.uv import uv_layout
from jaxface.imaging.colour import linear_to_srgb
from jaxface.io.face_models import load_model
from jaxface.io.formats.image import write_png
from jaxface.io.formats.obj import write_obj
from jaxface.io.skin_atlas import HEAD_COLUMNS, HEAD_ROWS, atlas_uv
from jaxface.pipeline.databases.makehuman import import_skins
from jaxface.pipeline.databases.scan import import_scan, register_scan

SIDE = 32  # texels of the databases
HALF_STEP = 0.005  # of 8 bits of sRGB, in linear light


@pytest.fixture(scope="module")
def model():
    return load_model("makehuman")


@pytest.fixture(scope="module")
def layout(model):
    return uv_layout(model.uv, model.uv_faces, SIDE)


def painted(uv: np.ndarray) -> np.ndarray:
    """A colour (linear RGB) that tells where on a map it is; u to the right, v upwards."""
    u, v = uv[..., 0], uv[..., 1]
    return np.stack([0.2 + 0.5 * u, 0.2 + 0.5 * v, 0.4 + 0 * u], axis=-1)


def coordinates(side: int) -> np.ndarray:
    """(u, v) of the texels of a square map, row 0 at the top."""
    line = (np.arange(side) + 0.5) / side
    return np.stack(np.meshgrid(line, 1 - line), axis=-1)


def encoded(linear: np.ndarray) -> np.ndarray:
    """16 bits of sRGB."""
    return np.round(65535 * np.asarray(linear_to_srgb(jnp.asarray(linear)))).astype(np.uint16)


def covered(model, layout, *regions: str) -> np.ndarray:
    """Texels that lie well inside regions of the face."""
    members = np.asarray(model.region_mask(*regions), np.float32)[:, None]
    inside = np.asarray(layout(members, model.faces)[..., 0]) > 0.999
    return inside & np.asarray(layout.inside)


def test_skins_land_where_the_atlas_says(tmp_path, model, layout):
    """A whole body map and the crop of its head give the same texture."""
    write_png(tmp_path / "body.png", encoded(painted(coordinates(256))))
    head = coordinates(2048)[slice(*HEAD_ROWS), slice(*HEAD_COLUMNS)]
    write_png(tmp_path / "crop.png", encoded(painted(np.rot90(head, -1))))
    told = []
    skins = [tmp_path / "body.png", tmp_path / "crop.png"]
    database = import_skins(
        skins, tmp_path / "db", SIDE, on_progress=lambda done, of: told.append((done, of))
    )
    assert database.names == ("body", "crop") and told == [(1, 2), (2, 2)]
    assert database.subjects[0].attributes == {"file": "body.png"}
    uv = np.asarray(layout(jnp.asarray(atlas_uv(model)), model.uv_faces, fill=jnp.nan))
    skin = covered(model, layout, "forehead", "cheeks", "chin", "nose") & np.isfinite(uv).all(-1)
    assert skin.sum() > 150
    for name in database.names:
        found = database.albedo(name)
        np.testing.assert_allclose(found[skin], painted(uv)[skin], atol=HALF_STEP, err_msg=name)
        eyes = covered(model, layout, "eyes")
        own = np.asarray(layout(model.albedo_mean, model.faces))[eyes]
        np.testing.assert_allclose(found[eyes], own, atol=HALF_STEP)
    written = {path: path.stat().st_mtime_ns for path in (tmp_path / "db").rglob("*.png")}
    again = import_skins(skins, tmp_path / "db", SIDE)
    assert again.names == database.names
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "db").rglob("*.png")} == written


BUMP, WIDTH = 4.0, 15.0  # mm: height and standard deviation of what the scan has on its forehead
TURN = np.array([[np.cos(0.1), 0, np.sin(0.1)], [0, 1, 0], [-np.sin(0.1), 0, np.cos(0.1)]])


def placed(points: np.ndarray) -> np.ndarray:
    """In the scan's own frame and units (cm)."""
    return 0.1 * points @ TURN.T + [2.0, 1.0, -3.0]


@pytest.fixture
def scan(tmp_path, model):
    """The mean head with a bump that no identity has, elsewhere, in cm, its UVs a quarter turned.

    The landmarks' file is given: no detector is needed.
    """
    mean = np.asarray(model.mean, np.float64)
    marks = np.asarray(model.landmarks68(model.mean), np.float64)
    above_brows = marks[[19, 24]].mean(axis=0) + [0, 30, 0]
    middle = mean[np.linalg.norm(mean - above_brows, axis=1).argmin()]

    def bumped(points: np.ndarray) -> np.ndarray:
        far = np.sum((points - middle) ** 2, axis=-1, keepdims=True)
        return points + BUMP * np.exp(-far / (2 * WIDTH**2)) * [0, 0, 1]

    uv = np.asarray(model.uv)
    write_obj(
        tmp_path / "scan.obj", placed(bumped(mean)), np.asarray(model.faces),
        uv=np.stack([uv[:, 1], 1 - uv[:, 0]], axis=1), uv_polygons=np.asarray(model.uv_faces),
    )  # fmt: skip
    write_png(tmp_path / "colour.png", encoded(painted(coordinates(128))))
    record = {
        "schema": "jaxface-landmarks/1", "scheme": "ibug68", "image_size": None,
        "points": placed(bumped(marks)).tolist(),
    }  # fmt: skip
    (tmp_path / "marks.json").write_text(json.dumps(record))
    on_bump = np.linalg.norm(mean - middle, axis=1) < WIDTH / 2
    return tmp_path, bumped(mean), on_bump


def test_a_scan_is_registered_and_its_colours_are_transferred(scan, model, layout):
    folder, truth, on_bump = scan
    told = []
    database, found = import_scan(
        folder / "scan.obj", folder / "colour.png", folder / "db", SIDE, subject="head",
        licence="CC0-1.0", landmarks=folder / "marks.json", attributes={"age": 30},
        on_progress=lambda done, of: told.append((done, of)),
    )  # fmt: skip
    assert told and told[-1][0] == told[-1][1] == len(told)
    summary = found.summary()
    assert summary["mm_per_unit"] == pytest.approx(10, rel=3e-4)  # 1.3e-4 measured
    assert summary["median_mm"] < 6e-4 and summary["p95_mm"] < 0.005  # 2.8e-4, 0.0024
    assert summary["landmarks_mm"] < 0.006  # 0.0027
    # The surface is the scan's, up to sliding along itself where nothing marks a place.
    error = np.linalg.norm(found.vertices - truth, axis=1)
    assert np.isfinite(error).mean() > 0.8
    assert np.nanmedian(error) < 0.07 and np.nanquantile(error, 0.95) < 0.25  # 0.044, 0.141
    lift = (found.vertices - np.asarray(model.mean))[on_bump, 2]
    assert len(lift) >= 3 and lift.mean() > 0.7 * BUMP  # 0.79 measured
    # Texels show what the scan's map has there, a quarter turned.
    uv = coordinates(SIDE)
    expected = painted(np.stack([uv[..., 1], 1 - uv[..., 0]], axis=-1))
    skin = covered(model, layout, "forehead", "cheeks", "chin", "nose")
    assert skin.sum() > 150
    np.testing.assert_allclose(database.albedo("head")[skin], expected[skin], atol=HALF_STEP)
    (subject,) = database.subjects
    assert subject.licence == "CC0-1.0"
    assert subject.attributes == {"file": "colour.png", **summary, "age": 30}


def test_a_scan_that_cannot_be_placed_is_refused(scan, model):
    folder, truth, _ = scan
    write_obj(folder / "bare.obj", placed(truth), np.asarray(model.faces))
    with pytest.raises(ValueError, match="no texture coordinates"):
        register_scan(folder / "bare.obj", landmarks=folder / "marks.json")
    with pytest.raises(ValueError, match="needs the scan's albedo"):
        register_scan(folder / "scan.obj", model=model)
    record = json.loads((folder / "marks.json").read_text())
    record["points"] = [point[:2] for point in record["points"]]
    (folder / "flat.json").write_text(json.dumps(record))
    with pytest.raises(ValueError, match="x, y, z are needed"):
        register_scan(folder / "scan.obj", model=model, landmarks=folder / "flat.json")
