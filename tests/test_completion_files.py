"""A completion's files and settings: what is checked before it, and the meshes it retextures."""

import dataclasses

import numpy as np
import pytest

from jaxface.io.face_models import load_model
from jaxface.io.fit_file import write_fit
from jaxface.io.formats.gltf import write_glb
from jaxface.io.formats.retexture import retexture_glb, retexture_obj
from jaxface.io.texture_database import TextureDatabase
from jaxface.models.parameters import neutral_parameters
from jaxface.pipeline.texture.folder import open_inputs
from jaxface.pipeline.texture.options import CompletionOptions, parse_detail
from jaxface.pipeline.texture.seen import fitted_model, read_folder_fit

SIZE = 256


@pytest.fixture(scope="module")
def model():
    return load_model("makehuman")


@pytest.fixture(scope="module")
def database(tmp_path_factory, model):
    made = TextureDatabase.create(
        tmp_path_factory.mktemp("db"), model, SIZE, name="grey", licence="CC0-1.0"
    )
    for index in range(2):
        made.write_subject(f"s{index}", np.full((SIZE, SIZE, 3), 0.3 + 0.1 * index))
    return made


def test_what_cannot_be_completed_is_told_beforehand(database, model, tmp_path):
    opened = open_inputs(model, SIZE, database.path)
    assert opened.database is not None and opened.database.names == database.names
    again = open_inputs(model, SIZE, opened.database, opened.network)
    assert again.database is opened.database and again.network is opened.network
    assert open_inputs(model, SIZE).database is None
    open_inputs(dataclasses.replace(model, name="other"), SIZE, database.path)
    with pytest.raises(ValueError, match="256 or more"):
        open_inputs(model, SIZE - 1, database.path)
    with pytest.raises(ValueError, match="1 subjects; 2 are needed"):
        alone = TextureDatabase.create(tmp_path, model, SIZE, name="alone", licence="CC0-1.0")
        alone.write_subject("s", np.full((SIZE, SIZE, 3), 0.5))
        open_inputs(model, SIZE, tmp_path)
    with pytest.raises(ValueError, match="UV"):
        open_inputs(dataclasses.replace(model, uv=model.uv[::-1]), SIZE, database.path)


def test_a_fit_of_another_model_is_named(model, tmp_path):
    def fitted(face, name):
        write_fit(tmp_path / "fit.npz", neutral_parameters(face), {}, {"model": name})

    def model_of(folder, given=None):
        return fitted_model(folder, read_folder_fit(folder), given)

    fitted(model, "makehuman")
    assert model_of(tmp_path) is not None and model_of(tmp_path, model) is model
    fitted(model, "other")
    other = dataclasses.replace(model, name="other")
    assert model_of(tmp_path, other) is other
    with pytest.raises(ValueError, match="--model"):
        model_of(tmp_path)
    with pytest.raises(ValueError, match="'other'.*not with 'makehuman'"):
        model_of(tmp_path, model)
    fewer = dataclasses.replace(model.identity, basis=model.identity.basis[..., :5])
    fewer = dataclasses.replace(fewer, std=model.identity.std[:5])
    fitted(dataclasses.replace(other, identity=fewer), "other")
    with pytest.raises(ValueError, match=r"of \[5, .*not with 'other'"):
        model_of(tmp_path, other)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"norm": "max"}, "norm is 'max'"),
        ({"iterations": 0}, "at least one"),
        ({"alpha": -1.0}, "alpha is -1.0; weights of 0 or more"),
        ({"start": "noise"}, "start is"),
        ({"detail": {"lips": 2.0}}, "detail of 'lips' is 2.0"),
        ({"keep_photo": float("nan")}, "weights of 0 or more"),
        ({"layers": ()}, "at least one layer"),
        ({"extent": "ears"}, "'face' or 'whole'"),
    ],
)
def test_options_are_checked(given, message):
    with pytest.raises(ValueError, match=message):
        CompletionOptions(**given)


def test_a_misspelt_option_is_a_type_error():
    with pytest.raises(TypeError, match="iteration"):
        CompletionOptions(**{"iteration": 7})


def test_detail_from_a_command_line():
    assert parse_detail("lips=0.5, nose=0") == {"lips": 0.5, "nose": 0.0}
    with pytest.raises(ValueError, match="region=value"):
        parse_detail("lips")


def test_as_published_differs_from_the_default_in_every_departure():
    default, paper = CompletionOptions(), CompletionOptions.as_published()
    same = {
        field.name
        for field in dataclasses.fields(CompletionOptions)
        if getattr(default, field.name) == getattr(paper, field.name)
    }
    # Equation 2's norm, equation 3's alpha and layers are the paper's by default.
    assert same == {"alpha", "norm", "iterations", "layers", "keep_plain", "detail"}
    assert paper.alpha == 2000 and paper.norm == "frobenius"


def test_another_texture_for_a_mesh_on_disk(tmp_path, model):
    from PIL import Image

    for name, colour in (("old", 10), ("new", 200)):
        Image.fromarray(np.full((8, 8, 3), colour, np.uint8)).save(tmp_path / f"{name}.png")
    old, new = ((tmp_path / f"{name}.png").read_bytes() for name in ("old", "new"))
    vertices = np.eye(3)
    faces = np.array([[0, 1, 2]])
    write_glb(
        tmp_path / "m.glb", vertices, faces, uv=np.eye(3)[:, :2], uv_faces=faces, texture=old,
        morphs={"a": np.ones((3, 3))}, weights={"a": 0.2},
    )  # fmt: skip
    before = (tmp_path / "m.glb").read_bytes()
    retexture_glb(tmp_path / "m.glb", new + b"\0" * 7)
    after = (tmp_path / "m.glb").read_bytes()
    assert old in before and old not in after and new in after
    retexture_glb(tmp_path / "m.glb", old)
    assert len((tmp_path / "m.glb").read_bytes()) == len(before)
    (tmp_path / "m.mtl").write_text("newmtl skin\nmap_Kd texture.png\n")
    retexture_obj(tmp_path / "m.obj", "albedo.png")
    assert "map_Kd albedo.png" in (tmp_path / "m.mtl").read_text()
    (tmp_path / "bad.glb").write_bytes(b"glTF")
    with pytest.raises(ValueError, match="not a readable GLB"):
        retexture_glb(tmp_path / "bad.glb", new)
    with pytest.raises(FileNotFoundError):
        retexture_glb(tmp_path / "none.glb", new)
