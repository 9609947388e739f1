"""The command line as a user types it."""

import json
import sys
import warnings

import numpy as np
import pytest
import typer
from PIL import Image
from typer.testing import CliRunner

import jaxface
from jaxface.cli import app
from jaxface.cli.console import errors
from jaxface.io.fit_file import read_fit

runner = CliRunner()


def run(*arguments: object):
    return runner.invoke(app, [str(a) for a in arguments])


def test_help_lists_the_commands():
    answer = run("--help")
    assert answer.exit_code == 0
    for name in ("digitize", "fit", "landmarks", "model"):
        assert name in answer.output


def one_error(output: str) -> str:
    """The only line that tells an error, which must be the last."""
    assert "Traceback" not in output
    lines = [line for line in output.splitlines() if line.strip()]
    assert [line.startswith("error: ") for line in lines] == [False] * (len(lines) - 1) + [True]
    return lines[-1]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("fit", "no_such_photo.jpg", "-o", "OUT"), "no file no_such_photo.jpg"),
        (("fit", "demo", "-o", "OUT", "--levels", "a,b"), "--levels is 'a,b'"),
        (("fit", "demo", "-o", "OUT", "--weights", "beauty=3"), "'beauty=3'"),
        (("fit", "demo", "-o", "OUT", "--weights", "photo=-1"), "'photo=-1'"),
        (("fit", "demo", "-o", "OUT", "--model", "nobody"), "no model 'nobody'"),
        (("fit", "demo", "-o", "OUT", "--face", "7"), "face 7"),
        (("fit", "demo", "-o", "OUT", "--shard", "1/2"), "need a folder of photos; demo is none"),
        (
            ("digitize", "demo", "-o", "OUT", "--scheduler", "tcp://127.0.0.1:1"),
            "need a folder of photos; demo is none",
        ),
        (("landmarks", "demo", "-o", "OUT", "--scheme", "dlib5"), "'dlib5'"),
        (("model", "info", "missing.npz"), "'missing.npz'"),
        (
            ("database", "build", "no_such_folder", "-o", "OUT", "--licence", "CC0-1.0"),
            "no folder of photos no_such_folder",
        ),
        (("database", "precompute", "no_such_folder"), "no_such_folder is no texture database"),
    ],
)
def test_mistakes_end_with_code_2_and_one_line(tmp_path, arguments, said):
    answer = run(*[tmp_path / "out" if a == "OUT" else a for a in arguments])
    assert answer.exit_code == 2, answer.output
    assert said in one_error(answer.output)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--database", "nowhere"), "nowhere is no texture database"),
        (("--features", "nobody"), "no feature weights at nobody"),
        (("--resolution", "100"), "resolution is 100"),
        (("--iterations", "0"), "iterations is 0"),
    ],
)
def test_a_completion_that_cannot_be_is_told_before_the_fit(tmp_path, arguments, said):
    answer = run("digitize", "demo", "-o", tmp_path / "out", *arguments)
    assert answer.exit_code == 2, answer.output
    assert said in one_error(answer.output)
    assert not (tmp_path / "out").exists()


def test_warnings_and_errors_are_one_line_with_their_brackets(capsys):
    with pytest.raises(typer.Exit), errors():
        warnings.warn("layer [float32] of [/a/b]", stacklevel=1)
        raise ValueError("shape is [1, 2]")
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["warning: layer [float32] of [/a/b]", "error: shape is [1, 2]"]


def test_version():
    assert run("--version").stdout.strip() == jaxface.__version__


def test_not_a_photo(tmp_path):
    file = tmp_path / "notes.jpg"
    file.write_text("not a photo")
    answer = run("fit", file, "-o", tmp_path / "out")
    assert answer.exit_code == 2
    assert "notes.jpg" in answer.output.replace("\n", "")


def test_no_face(tmp_path):
    file = tmp_path / "noise.png"
    noise = np.random.default_rng(0).integers(0, 255, (200, 200, 3))
    Image.fromarray(noise.astype(np.uint8)).save(file)
    answer = run("landmarks", file, "-o", tmp_path / "out")
    assert answer.exit_code == 2
    assert "no face" in answer.output.replace("\n", " ")


def test_empty_folder(tmp_path):
    answer = run("fit", tmp_path, "-o", tmp_path / "out")
    assert answer.exit_code == 2
    assert "no photo" in answer.output.replace("\n", " ")


@pytest.fixture
def fitted(monkeypatch):
    """Names of the photos that are fitted, by a stand-in that writes a report alone."""
    names = []

    def stand_in(photo, out, opened, *, on_step):
        names.append(photo.name)
        if photo.read_bytes() == b"broken":
            raise ValueError("no face [in] it")
        on_step("synthesis", 1, 1)
        out.mkdir(parents=True)
        (out / "report.json").write_text("{}")

    monkeypatch.setattr("jaxface.pipeline._digitize.digitize_opened", stand_in)
    return names


def test_a_folder_by_shards(tmp_path, fitted):
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in "edcba":
        (photos / f"{name}.png").write_bytes(b"broken" if name == "d" else b"pixels")
    given = ("fit", photos, "-o", tmp_path / "out", "--shard")
    answer = run(*given, "2/2")
    assert answer.exit_code == 2, answer.output
    assert fitted == ["b.png", "d.png"]
    assert "b.png: done" in answer.output and "d.png: no face [in] it" in answer.output
    assert "1 of 2 photos" in answer.output and "photos 2/2" in answer.output
    answer = run(*given, "1/2")
    assert answer.exit_code == 0, answer.output
    assert fitted[2:] == ["a.png", "c.png", "e.png"]
    assert "b.png: done before" in run("fit", photos, "-o", tmp_path / "out").output
    assert run(*given, "6/6").exit_code == 0  # more shards than photos
    answer = run(*given, "3/2")
    assert answer.exit_code == 2 and "shard is '3/2'" in answer.output


def test_a_scheduler_without_its_package(tmp_path, fitted, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    (tmp_path / "a.png").write_bytes(b"pixels")
    answer = run("fit", tmp_path, "-o", tmp_path / "out", "--scheduler", "tcp://127.0.0.1:1")
    assert answer.exit_code == 2 and not fitted
    assert "pip install 'jaxface[cluster]'" in answer.output.replace("\n", " ")


def test_landmarks_of_the_demo(tmp_path):
    answer = run("landmarks", "demo", "-o", tmp_path, "--scheme", "ibug68")
    assert answer.exit_code == 0, answer.output
    record = json.loads((tmp_path / "landmarks_0.json").read_text())
    assert len(record["points"]) == 68
    assert (tmp_path / "landmarks_0.pts").is_file()
    with Image.open(tmp_path / "landmarks.png") as picture:
        assert picture.size == (512, 512)


def test_model_info_json():
    answer = run("model", "info", "makehuman", "--json")
    assert answer.exit_code == 0
    facts = json.loads(answer.stdout)
    assert facts["expression_modes"] == 52
    assert facts["landmarks68"] and facts["landmarks468"]


def test_a_folder_that_makes_no_database(tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "notes.txt").write_text("no photo")
    build = ("database", "build", photos, "-o", tmp_path / "out", "--licence")
    answer = run(*build, "CC0-1.0")
    assert answer.exit_code == 2 and "no photo" in answer.output
    (photos / "a.jpg").write_bytes(b"broken")
    for arguments, told in [
        ((" ",), "licence is empty"),
        (("CC0-1.0", "--resolution", "5"), "resolution is 5"),
        (("CC0-1.0", "--resolution", "64"), "a.jpg"),
    ]:
        answer = run(*build, *arguments)
        assert answer.exit_code == 2 and told in answer.output, answer.output
        assert "Traceback" not in answer.output
    assert not (tmp_path / "out" / "database.json").exists()


def test_precompute_says_its_size_and_goes_on(tmp_path):
    from jaxface.io.face_models import load_model
    from jaxface.io.texture_database import TextureDatabase

    database = TextureDatabase.create(
        tmp_path, load_model("makehuman"), 64, name="noise", licence="CC0-1.0"
    )
    for seed, name in enumerate(("a", "b")):
        texture = np.random.default_rng(seed).random((64, 64, 3)).astype(np.float32)
        database.write_subject(name, texture)
    answer = run("database", "precompute", tmp_path, "--limit", "1e-6")
    assert answer.exit_code == 2 and "would hold" in answer.output
    first = run("database", "precompute", tmp_path)
    assert first.exit_code == 0, first.output
    assert "GB" in first.output
    files = sorted((tmp_path / "grams").glob("*.grams"))
    assert len(files) == 2
    stamps = [file.stat().st_mtime_ns for file in files]
    assert run("database", "precompute", tmp_path).exit_code == 0
    assert [file.stat().st_mtime_ns for file in files] == stamps
    assert run("database", "precompute", tmp_path, "--resolution", "48").exit_code == 2


@pytest.mark.slow
def test_database_from_photos_goes_on_where_it_stopped(tmp_path):
    from skimage import data

    photos = tmp_path / "photos"
    photos.mkdir()
    Image.fromarray(data.astronaut()).save(photos / "a.png")
    (photos / "b.jpg").write_bytes(b"broken")
    build = ("database", "build", photos, "-o", tmp_path / "db", "--licence", "public domain")
    build = (*build, "--resolution", "128", "--size", "128")
    first = run(*build)
    assert first.exit_code == 2 and "b.jpg" in first.output, first.output
    texture = tmp_path / "db" / "textures" / "a.png"
    stamp = texture.stat().st_mtime_ns
    (photos / "b.jpg").unlink()
    second = run(*build)
    assert second.exit_code == 0, second.output
    assert texture.stat().st_mtime_ns == stamp
    facts = json.loads(run("database", "info", tmp_path / "db", "--json").stdout)
    assert facts["subjects"] == 1 and not facts["missing"]


@pytest.mark.slow
def test_digitize_demo_then_a_folder_that_resumes(tmp_path):
    """The whole journey at a small size, then a folder with one bad file, twice."""
    from skimage import data

    small = ("--size", "128", "--levels", "6,2", "--details", "0,0")
    answer = run(
        "digitize", "demo", "-o", tmp_path / "one", *small, "--resolution", "256",
        "--iterations", "6",
    )  # fmt: skip
    assert answer.exit_code == 0, answer.output
    names = (
        "mesh.obj", "mesh.glb", "fit.npz", "albedo_partial.exr", "albedo_partial.png",
        "visibility.png", "overlay.png", "report.html", "report.json", "albedo.exr",
        "albedo.png", "blend.json", "grams.npz", "completion.png", "face.png",
    )  # fmt: skip
    assert not [n for n in names if not (tmp_path / "one" / n).is_file()]
    saved = read_fit(tmp_path / "one" / "fit.npz")
    assert saved.metadata["model"] == "makehuman"
    assert all(np.isfinite(np.asarray(x)).all() for x in saved.arrays.values())
    assert set(saved.metadata["energies"]) >= {"total", "photo", "landmark", "prior"}
    report = json.loads((tmp_path / "one" / "report.json").read_text())
    assert report["energies"] and report["timings"] and report["licences"]
    blend = json.loads((tmp_path / "one" / "blend.json").read_text())
    assert abs(sum(entry["weight"] for entry in blend["weights"]) - 1) < 1e-5
    assert blend["relative_gap"] <= 1e-6
    assert (tmp_path / "one" / "albedo.png").read_bytes() in (
        tmp_path / "one" / "mesh.glb"
    ).read_bytes()
    assert not (tmp_path / "one" / ".completion").exists()

    photos = tmp_path / "photos"
    photos.mkdir()
    Image.fromarray(data.astronaut()).save(photos / "a.png")
    (photos / "b.jpg").write_bytes(b"broken")
    first = run("fit", photos, "-o", tmp_path / "many", *small)
    assert first.exit_code == 2
    assert "b.jpg" in first.output and "1 of 2" in first.output
    stamp = (tmp_path / "many" / "a" / "report.json").stat().st_mtime_ns
    (photos / "b.jpg").unlink()
    second = run("fit", photos, "-o", tmp_path / "many", *small)
    assert second.exit_code == 0, second.output
    assert "done before" in second.output
    assert (tmp_path / "many" / "a" / "report.json").stat().st_mtime_ns == stamp
