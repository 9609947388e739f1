"""Databases from folders of photos: bad folders, and two photos from end to end."""

import numpy as np
import pytest
from PIL import Image
from skimage import data

from jaxface.pipeline.databases.from_photos import build_database, subject_name


def test_bad_folders_are_told(tmp_path):
    with pytest.raises(FileNotFoundError, match="no folder"):
        build_database(tmp_path / "absent", tmp_path / "db", licence="CC0-1.0")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="holds no photo"):
        build_database(tmp_path / "empty", tmp_path / "db", licence="CC0-1.0")
    with pytest.raises(ValueError, match="licence is empty"):
        build_database(tmp_path / "empty", tmp_path / "db", licence=" ")
    (tmp_path / "empty" / "a.jpg").write_bytes(b"no image")
    (tmp_path / "empty" / "a.png").write_bytes(b"no image")
    with pytest.raises(ValueError, match="one subject"):
        build_database(tmp_path / "empty", tmp_path / "db", licence="CC0-1.0")


def test_names_are_cleaned():
    assert subject_name("a/CFD WF-001 (N).jpg") == "CFD-WF-001-N-"


@pytest.mark.slow
def test_two_photos_become_textures_and_a_second_run_adds_nothing(tmp_path):
    folder, out = tmp_path / "photos", tmp_path / "db"
    folder.mkdir()
    photo = data.astronaut()
    Image.fromarray(photo).save(folder / "one.png")
    Image.fromarray((photo * 0.7).astype(np.uint8)).save(folder / "two.png")
    (folder / "broken.jpg").write_bytes(b"no image")
    told = []
    options = {"licence": "public domain", "size": 128, "on_progress": told.append}
    database = build_database(folder, out, 256, **options)
    assert database.names == ("one", "two")
    assert [s.photo.name for s in told if s.stage == "fit" and s.problem] == ["broken.jpg"]
    for subject in database.subjects:
        assert subject.attributes["landmark_error"] < 0.05
        assert 0.02 < database.encoded(subject.name).mean() < 0.98
    written = (out / "textures" / "one.png").stat().st_mtime_ns
    build_database(folder, out, 256, **options)
    assert (out / "textures" / "one.png").stat().st_mtime_ns == written
