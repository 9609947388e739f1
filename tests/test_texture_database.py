"""The texture database on disk: what it keeps, resumes and refuses."""

import json

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxface.geometry.uv import uv_layout
from jaxface.io.face_models import load_model
from jaxface.io.formats.image import write_png
from jaxface.io.skin_atlas import atlas_uv, read_skin, skin_name
from jaxface.io.texture_database import (
    INDEX,
    LOCK,
    SCHEMA,
    TextureDatabase,
    databases_dir,
)
from jaxface.models.maps import uv_digest
from jaxface.pipeline.databases.makehuman import import_skins
from jaxface.pipeline.databases.painted import synth_database
from jaxface.run.compile_cache import ENVIRONMENT


@pytest.fixture(scope="module")
def model():
    return load_model("makehuman")


def new(path, model, resolution=16):
    return TextureDatabase.create(
        path, model, resolution, name="some", licence="CC0-1.0", credits=["nobody"]
    )


def ramp(resolution=16):
    x = np.linspace(0, 1, resolution, dtype=np.float32)
    return np.stack(np.broadcast_arrays(x[:, None], x[None] ** 2, 0.5 * x[:, None]), axis=-1)


def test_what_is_written_is_read(tmp_path, model):
    database = new(tmp_path / "d", model)
    database.write_subject("one", ramp(), attributes={"age": 30.0, "tone": [0.1, 0.2]})
    database.write_subject("two", ramp()[::-1], licence="CC-BY 3.0, somebody")
    again = TextureDatabase(tmp_path / "d", model)
    assert again.names == ("one", "two") and len(again) == 2 and "one" in again
    assert again.subjects[0].attributes == {"age": 30.0, "tone": [0.1, 0.2]}
    assert again.subjects[1].licence == "CC-BY 3.0, somebody"
    # 8 bits of sRGB: half a step, in linear light at most 1 / 255 * 2.4 / 2.
    np.testing.assert_allclose(again.albedo("one"), ramp(), atol=0.005)
    encoded = list(again)
    assert encoded[0].dtype == np.float32 and encoded[0].shape == (16, 16, 3)
    np.testing.assert_array_equal(encoded[0], encoded[1][::-1])


def test_a_subject_is_replaced_in_place(tmp_path, model):
    database = new(tmp_path, model)
    database.write_subject("one", ramp())
    database.write_subject("one", 0 * ramp())
    assert database.names == ("one",)
    assert TextureDatabase(tmp_path).encoded("one").max() == 0


def test_nothing_temporary_is_left_and_a_failed_write_changes_nothing(tmp_path, model):
    database = new(tmp_path, model)
    database.write_subject("one", ramp())
    before = (tmp_path / INDEX).read_text()
    with pytest.raises(TypeError):
        database.write_subject("two", ramp(), attributes={"what": object()})
    with pytest.raises(ValueError, match="NaN or infinite"):
        database.write_subject("two", ramp() * np.nan)
    assert (tmp_path / INDEX).read_text() == before and database.names == ("one",)
    found = {p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*") if p.is_file()}
    assert found - {LOCK} == {INDEX, "textures/one.png"}


def test_it_goes_on_where_it_stopped(tmp_path, model):
    new(tmp_path, model).write_subject("one", ramp())
    again = new(tmp_path, model)
    assert again.is_whole("one") and not again.is_whole("two")
    more = TextureDatabase.create(
        tmp_path, model, 16, name="x", licence="y", credits=["nobody", "somebody"]
    )
    assert more.credits == TextureDatabase(tmp_path).credits == ("nobody", "somebody")
    assert more.name == "some" and more.names == ("one",)
    with pytest.raises(ValueError, match="16 texels, not 32"):
        new(tmp_path, model, 32)
    write_png(tmp_path / "textures" / "one.png", np.zeros((8, 8, 3), np.uint8))
    assert not again.is_whole("one")
    assert again.info()["missing"] == ["one"]
    with pytest.raises(ValueError, match="8x8 texels"):
        again.encoded("one")
    (tmp_path / "textures" / "one.png").unlink()
    with pytest.raises(ValueError, match="cannot be read"):
        again.albedo("one")


def test_info(tmp_path, model):
    database = new(tmp_path, model)
    database.write_subject("one", ramp(), licence="CC-BY 3.0")
    info = database.info()
    assert info["subjects"] == 1 and info["resolution"] == 16 and info["missing"] == []
    assert info["bytes"] == (tmp_path / "textures" / "one.png").stat().st_size
    assert info["licences"] == ["CC-BY 3.0"] and info["credits"] == ["nobody"]


@pytest.mark.parametrize("name", ["", "../up", "a/b", ".hidden", "a b", "x" * 101])
def test_bad_names(tmp_path, model, name):
    with pytest.raises(ValueError, match="subject name"):
        new(tmp_path, model).write_subject(name, ramp())


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"schema": "other/9"}, "this version reads"),
        ({"resolution": "big"}, "lacks or misspells"),
        ({"uv": {}}, "lacks or misspells"),
        ({"subjects": [{"name": "a", "file": "../../x.png", "licence": ""}]}, "outside"),
        ({"subjects": [{"name": "a", "file": "/etc/x.png", "licence": ""}]}, "outside"),
        ({"subjects": [{"name": "a", "file": "x", "licence": ""}] * 2}, "twice"),
        ({"subjects": [{"title": "a"}]}, "lacks or misspells"),
    ],
)
def test_damaged_indices(tmp_path, model, change, said):
    new(tmp_path, model)
    content = json.loads((tmp_path / INDEX).read_text())
    assert content["schema"] == SCHEMA
    (tmp_path / INDEX).write_text(json.dumps({**content, **change}))
    with pytest.raises(ValueError, match=said):
        TextureDatabase(tmp_path)


def test_not_a_database(tmp_path, model):
    with pytest.raises(FileNotFoundError, match="no texture database"):
        TextureDatabase(tmp_path)
    (tmp_path / INDEX).write_text("{")
    with pytest.raises(ValueError, match="not valid JSON"):
        TextureDatabase(tmp_path)
    with pytest.raises(KeyError, match="no subject"):
        new(tmp_path / "x", model).encoded("nobody")


def test_a_database_in_the_cache_goes_by_its_name(tmp_path, model, monkeypatch):
    monkeypatch.setenv(ENVIRONMENT, str(tmp_path))
    made = new(databases_dir() / "mine", model)
    assert TextureDatabase("mine", model).path == made.path
    monkeypatch.chdir(tmp_path)
    nearer = new(tmp_path / "mine", model, 32)
    assert TextureDatabase("mine").path.resolve() == nearer.path
    with pytest.raises(FileNotFoundError, match=r"in the cache \(there: mine\)"):
        TextureDatabase("yours")
    with pytest.raises(FileNotFoundError):
        TextureDatabase(tmp_path / "nowhere" / "mine")


def test_uvs_of_another_model(tmp_path, model):
    new(tmp_path, model)
    other = eqx.tree_at(lambda m: m.uv, model, model.uv * 0.5)
    assert uv_digest(other) != uv_digest(model)
    with pytest.raises(ValueError, match="UVs of model"):
        TextureDatabase(tmp_path, other)


def test_synth_resumes_and_is_reproducible(tmp_path, model):
    seen = []
    first = synth_database(tmp_path / "a", 1, 128, 5, lambda done, of: seen.append((done, of)))
    assert seen == [(1, 1)] and first.subjects[0].attributes["seed"] == [5, 0]
    file = tmp_path / "a" / first.subjects[0].file
    stamp = file.stat().st_mtime_ns
    second = synth_database(tmp_path / "a", 2, 128, 5)
    assert len(second) == 2 and file.stat().st_mtime_ns == stamp
    other = synth_database(tmp_path / "b", 1, 128, 5)
    np.testing.assert_array_equal(other.encoded(other.names[0]), first.encoded(first.names[0]))
    with pytest.raises(ValueError, match="at least 1"):
        synth_database(tmp_path / "c", 0)


def test_atlas_is_continuous_on_the_face(model):
    source = atlas_uv(model)
    layout = uv_layout(model.uv, model.uv_faces, 64)
    place = np.asarray(layout(jnp.asarray(source), model.uv_faces, fill=np.nan))
    # The face keeps its proportions: one scale for u and v over its middle.
    face = place[34:52, 22:42]
    assert np.isfinite(face).all()
    along = np.linalg.norm(np.diff(face, axis=1), axis=-1)
    down = np.linalg.norm(np.diff(face, axis=0), axis=-1)
    np.testing.assert_allclose(along, np.median(along), rtol=0.02)
    np.testing.assert_allclose(down, np.median(along), rtol=0.02)


def test_skins_by_their_shape(tmp_path, model):
    write_png(tmp_path / "odd.png", np.zeros((32, 48, 3), np.uint8))
    with pytest.raises(ValueError, match="48x32 px"):
        read_skin(tmp_path / "odd.png")
    write_png(tmp_path / "body map.png", np.full((32, 32, 3), 100, np.uint8))
    pixels, known = read_skin(tmp_path / "body map.png")
    assert pixels.shape == (32, 32, 3) and known.all()
    assert skin_name(tmp_path / "body map.png") == "body-map"
    other = eqx.tree_at(lambda m: m.uv, model, model.uv[:-1])
    with pytest.raises(ValueError, match="fit the bundled model"):
        atlas_uv(other)


def test_makehuman_skin_lands_on_the_face(tmp_path, model, data_dir):
    file = data_dir / "makehuman_albedo" / "young_lightskinned_male.png"
    if not file.is_file():
        pytest.skip(f"no {file}")
    database = import_skins(
        [
            file,
        ],
        tmp_path / "d",
        256,
    )
    albedo = database.albedo("young_lightskinned_male")
    at = np.asarray(model.uv)[np.asarray(model.uv_faces)].mean(axis=1)
    region = np.asarray(model.region)[np.asarray(model.faces)]

    def colour(name):
        inside = (region == model.region_names.index(name)).all(axis=1)
        x, y = at[inside].T * 256
        return albedo[(256 - y).astype(int), x.astype(int)].mean(axis=0)

    lips, cheeks, scalp = colour("lips"), colour("cheeks"), colour("scalp")
    assert lips[0] / lips[1] > 1.15 * cheeks[0] / cheeks[1]
    assert scalp.sum() < 0.9 * cheeks.sum()
    assert 0.3 < cheeks[0] < 0.95
