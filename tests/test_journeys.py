"""Whole journeys: what is checked before a fit, and what goes on after it. Fits are stand-ins."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from jaxface.io.face_models import load_model
from jaxface.io.texture_database import TextureDatabase
from jaxface.pipeline import _digitize as journeys
from jaxface.pipeline import folder as folders
from jaxface.pipeline._digitize import digitize
from jaxface.pipeline.folder import digitize_folder

PHOTO = np.full((64, 64, 3), 0.5, np.float32)


@pytest.fixture(scope="module")
def other():
    return dataclasses.replace(load_model("makehuman"), name="other")


@pytest.fixture(scope="module")
def database(tmp_path_factory, other):
    made = TextureDatabase.create(
        tmp_path_factory.mktemp("db"), other, 256, name="grey", licence="CC0-1.0"
    )
    for index in range(2):
        made.write_subject(f"s{index}", np.full((256, 256, 3), 0.3 + 0.1 * index))
    return made.path


@pytest.fixture
def told(monkeypatch):
    """What a journey called, in order: fits by their model, completions by their arguments."""
    calls = []

    def fit(photo, **options):
        calls.append(("fit", options["model"]))
        return SimpleNamespace(model=options["model"])

    def save_fit(fitted, out, *, textured, title, clock):
        out.mkdir(parents=True, exist_ok=True)
        (out / "report.json").write_text("{}")

    def complete_folder(folder, **given):
        calls.append(("complete", given))
        (folder / "albedo.png").write_bytes(b"")

    monkeypatch.setattr(journeys, "fit", fit)
    monkeypatch.setattr(journeys, "texture", lambda fitted, resolution, clock: None)
    monkeypatch.setattr(journeys, "save_fit", save_fit)
    monkeypatch.setattr(journeys, "complete_folder", complete_folder)
    monkeypatch.setattr(folders, "complete_folder", complete_folder)
    return calls


def test_the_completion_is_of_the_model_that_was_fitted(told, other, database, tmp_path):
    digitize(PHOTO, tmp_path / "a", model=other, complete=True, completion={"database": database})
    assert [what for what, _ in told] == ["fit", "complete"]
    assert told[0][1] is other and told[1][1]["model"] is other
    assert told[1][1]["database"] == database


def test_a_model_without_a_database_is_fitted_alone(told, other, tmp_path):
    with pytest.warns(UserWarning, match="no database in the UVs of 'other'"):
        digitize(
            PHOTO, tmp_path / "a", model=other, resolution=128, complete=True,
            completion={"features": "nobody"},
        )  # fmt: skip
    assert told == [("fit", other)]


@pytest.mark.parametrize(
    "wrong",
    [
        {"resolution": 128},
        {"completion": {"resolution": 128}},
        {"completion": {"features": "nobody"}},
        {"completion": {"database": "nowhere"}},
    ],
)
def test_what_would_stop_a_completion_stops_before_the_fit(told, tmp_path, wrong):
    with pytest.raises((ValueError, FileNotFoundError)):
        digitize(PHOTO, tmp_path / "a", complete=True, **wrong)
    with pytest.raises((ValueError, FileNotFoundError)):
        list(digitize_folder([tmp_path / "a.png"], tmp_path, complete=True, **wrong))
    assert not told


def test_the_completions_own_resolution_counts(told, tmp_path):
    digitize(
        PHOTO, tmp_path / "a", resolution=128, complete=True, completion={"resolution": 256}
    )  # fmt: skip
    assert [what for what, _ in told] == ["fit", "complete"]


def test_a_folder_completes_what_is_fitted_already(told, other, database, tmp_path):
    photos = [tmp_path / "a.png", tmp_path / "b.png"]
    for photo in photos:
        Image.fromarray(np.uint8(255 * PHOTO)).save(photo)
    list(digitize_folder(photos, tmp_path / "out", model=other))
    assert told == [("fit", other)] * 2
    told.clear()
    given = {"model": other, "complete": True, "completion": {"database": database}}
    entries = list(digitize_folder(photos, tmp_path / "out", **given))
    assert [entry.error for entry in entries] == [None, None]
    assert [what for what, _ in told] == ["complete"] * 2
    assert all(found["model"] is other for _, found in told)
    told.clear()
    list(digitize_folder(photos, tmp_path / "out", **given))
    assert not told
