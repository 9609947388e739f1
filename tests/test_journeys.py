"""Whole journeys: what is checked before a fit, and what goes on after it. Fits are stand-ins."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from jaxface.cli import app
from jaxface.io.face_models import load_model
from jaxface.io.texture_database import TextureDatabase
from jaxface.pipeline import _digitize as journeys
from jaxface.pipeline._digitize import digitize
from jaxface.pipeline.folder import digitize_folder
from jaxface.pipeline.options import DigitizeOptions
from jaxface.pipeline.texture.options import CompletionOptions
from jaxface.stages.fit.options import FitOptions

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

    def fit(photo, model, options, **given):
        calls.append(("fit", model))
        return SimpleNamespace(model=model)

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
    return calls


def test_the_completion_is_of_the_model_that_was_fitted(told, other, database, tmp_path):
    digitize(PHOTO, tmp_path / "a", model=other, database=database)
    assert [what for what, _ in told] == ["fit", "complete"]
    assert told[0][1] is other and told[1][1]["model"] is other
    assert told[1][1]["database"].path == database
    assert told[1][1]["features"].name == "random compact"


def test_a_model_without_a_database_is_fitted_alone(told, other, tmp_path):
    with pytest.warns(UserWarning, match="no database in the UVs of 'other'"):
        digitize(
            PHOTO, tmp_path / "a", model=other, resolution=128, features="nobody"
        )  # fmt: skip
    assert told == [("fit", other)]


@pytest.mark.parametrize(
    "wrong",
    [
        {"resolution": 128},
        {"features": "nobody"},
        {"database": "nowhere"},
    ],
)
def test_what_would_stop_a_completion_stops_before_the_fit(told, tmp_path, wrong):
    with pytest.raises((ValueError, FileNotFoundError)):
        digitize(PHOTO, tmp_path / "a", **wrong)
    with pytest.raises((ValueError, FileNotFoundError)):
        list(digitize_folder([tmp_path / "a.png"], tmp_path, **wrong))
    assert not told


def test_a_misspelt_setting_is_a_type_error(told, tmp_path):
    for run in (digitize, lambda photo, out, **given: list(digitize_folder([], out, **given))):
        with pytest.raises(TypeError, match="resolutions"):
            run(PHOTO, tmp_path / "a", **{"resolutions": 512})
    assert not told


def test_the_command_and_python_have_the_same_defaults(told, monkeypatch, tmp_path):
    """What the command line gives without options is the record itself."""
    given = []
    monkeypatch.setattr("jaxface.cli._run", lambda photo, out, asked, *more: given.append(asked))
    for arguments in (["digitize"], ["fit"], ["digitize", "--as-published"]):
        found = CliRunner().invoke(app, [*arguments, "demo", "-o", str(tmp_path)])
        assert found.exit_code == 0, found.output
    assert given[0] == DigitizeOptions()
    assert given[1] == DigitizeOptions(with_texture=False)
    assert given[2] == DigitizeOptions.as_published()
    found = CliRunner().invoke(
        app,
        ["digitize", "demo", "-o", str(tmp_path), "--levels", "4,2", "--no-complete",
         "--keep-photo", "3", "--detail", "nose=0.5", "--freeze", "expression"],
    )  # fmt: skip
    assert found.exit_code == 0, found.output
    assert given[3] == DigitizeOptions(
        fit=FitOptions(steps=(4, 2), freeze=("expression",)), complete=False,
        completion=CompletionOptions(keep_photo=3.0, detail={"nose": 0.5}),
    )  # fmt: skip


def test_a_folder_completes_what_is_fitted_already(told, other, database, tmp_path):
    photos = [tmp_path / "a.png", tmp_path / "b.png"]
    for photo in photos:
        Image.fromarray(np.uint8(255 * PHOTO)).save(photo)
    list(digitize_folder(photos, tmp_path / "out", model=other, complete=False))
    assert told == [("fit", other)] * 2
    told.clear()
    given = {"model": other, "database": database}
    entries = list(digitize_folder(photos, tmp_path / "out", **given))
    assert [entry.error for entry in entries] == [None, None]
    assert [what for what, _ in told] == ["complete"] * 2
    assert all(found["model"] is other for _, found in told)
    told.clear()
    list(digitize_folder(photos, tmp_path / "out", **given))
    assert not told
