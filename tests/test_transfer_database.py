"""A database carried into another model's UVs, where the right answer is known."""

import dataclasses
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

from jaxface.cli import app
from jaxface.geometry.uv import uv_layout
from jaxface.io.face_models import load_model
from jaxface.io.texture_database import TextureDatabase
from jaxface.models.linear import LinearBasis, empty_basis
from jaxface.models.morphable import MorphableModel, SurfacePoints
from jaxface.pipeline.databases import transferred
from jaxface.pipeline.databases.transferred import transfer_database
from jaxface.stages.scan.register import register_topology

SIDE = 128
STEP = 1 / 255


@pytest.fixture(scope="module")
def source():
    return load_model("makehuman")


@pytest.fixture(scope="module")
def target(source) -> MorphableModel:
    """The front of the bundled head, larger, its vertices in another order, its UVs turned."""
    faces, uv_faces = np.asarray(source.faces), np.asarray(source.uv_faces)
    mean = np.asarray(source.mean, np.float64)
    hidden = np.asarray(source.region_mask("eyes", "mouth_interior", "ears", "scalp"))
    kept = ~hidden & (mean[:, 2] > np.quantile(mean[:, 2], 0.6))
    kept[np.asarray(source.landmarks68.vertices)] = True
    inside = kept[faces].all(axis=1)
    used = np.unique(faces[inside])
    order = np.random.default_rng(0).permutation(used)
    number = np.full(len(mean), -1)
    number[order] = np.arange(len(order))
    marks = SurfacePoints(
        jnp.asarray(number[np.asarray(source.landmarks68.vertices)], jnp.int32),
        source.landmarks68.weights,
    )
    stretch = np.array([1.15, 1.1, 1.1])
    return MorphableModel(
        mean=jnp.asarray(mean[order] * stretch + [3.0, -8.0, 5.0], jnp.float32),
        identity=LinearBasis(source.identity.basis[order, :, :20], source.identity.std[:20]),
        expression=empty_basis(len(order)),
        albedo_mean=source.albedo_mean[order],
        albedo=LinearBasis(jnp.zeros((len(order), 3, 0)), jnp.zeros(0)),
        faces=jnp.asarray(number[faces[inside]], jnp.int32),
        uv=jnp.asarray(turned(np.asarray(source.uv)), jnp.float32),
        uv_faces=jnp.asarray(uv_faces[inside]),
        landmarks68=marks,
        landmarks468=None,
        region=source.region[order],
        name="front",
        region_names=source.region_names,
        expression_names=(),
        licence="",
    )


def turned(uv: np.ndarray) -> np.ndarray:
    """A quarter turn, mirrored and smaller."""
    return np.stack([0.05 + 0.9 * uv[:, 1], 0.1 + 0.8 * uv[:, 0]], axis=1)


def painted(uv: np.ndarray, phase: float) -> np.ndarray:
    """A smooth colour (linear RGB) that tells where on a map it is."""
    u, v = uv[..., 0], uv[..., 1]
    return np.stack([0.2 + 0.5 * u, 0.2 + 0.5 * v, 0.4 + 0.2 * np.sin(3 * u + phase)], axis=-1)


@pytest.fixture(scope="module")
def textures(source, tmp_path_factory) -> TextureDatabase:
    made = TextureDatabase.create(
        tmp_path_factory.mktemp("textures"), source, SIDE, name="maps", licence="CC0-1.0",
        credits=("somebody",),
    )  # fmt: skip
    line = (np.arange(SIDE) + 0.5) / SIDE
    uv = np.stack(np.meshgrid(line, 1 - line), axis=-1)
    made.write_subject("a", painted(uv, 0.0), attributes={"age": 30})
    made.write_subject("b", painted(uv, 2.0), licence="CC-BY-4.0")
    return made


def test_textures_land_where_they_belong(source, target, textures, tmp_path, monkeypatch):
    told, registered = [], []

    def once(*arguments, **options):
        if not registered:
            registered.append(register_topology(*arguments, **options))
        return registered[0]

    monkeypatch.setattr(transferred, "register_topology", once)
    made = transfer_database(
        target, tmp_path, textures.path, on_progress=lambda *step: told.append(step)
    )
    assert made.names == ("a", "b") and made.resolution == SIDE and made.credits == ("somebody",)
    assert made.subjects[0].attributes == {"age": 30, "transferred": "maps"}
    assert [s.licence for s in made.subjects] == ["CC0-1.0", "CC-BY-4.0"]
    assert told[-1] == ("textures", 2, 2) and ("registration", 9, 9) in told
    TextureDatabase(tmp_path, target)  # in this model's UVs, as a completion asks
    layout = uv_layout(target.uv, target.uv_faces, SIDE)
    was = np.asarray(layout(source.uv, target.uv_faces))  # where the texel is in the source's maps
    face = np.asarray(target.region_mask("nose", "cheeks", "chin", "lips", "forehead"))
    inside = np.asarray(layout(jnp.asarray(face[:, None], jnp.float32), target.faces))[..., 0]
    inside = (inside > 0.999) & np.asarray(layout.inside)
    assert inside.sum() > 500
    for name, phase in (("a", 0.0), ("b", 2.0)):
        off = np.abs(made.albedo(name) - painted(was, phase))[inside].max(axis=-1)
        # 0.005 is a hundredth of the map, 1.3 of its texels.
        assert np.median(off) < 0.005 and np.quantile(off, 0.95) < 0.015, name
    # A whole database is left alone; what a killed run lacks is made again, and the same.
    before = {name: made.encoded(name) for name in made.names}
    (tmp_path / "textures" / "b.png").unlink()
    untouched = (tmp_path / "textures" / "a.png").stat().st_mtime_ns
    again = transfer_database(target, tmp_path, textures.path)
    assert (tmp_path / "textures" / "a.png").stat().st_mtime_ns == untouched
    for name in made.names:
        np.testing.assert_array_equal(again.encoded(name), before[name])
    monkeypatch.setattr(transferred, "register_topology", None)
    assert transfer_database(target, tmp_path, textures.path).names == ("a", "b")


def test_what_cannot_be_transferred_is_told(source, target, textures, tmp_path):
    with pytest.raises(ValueError, match="nothing to transfer"):
        transfer_database("makehuman", tmp_path, textures.path)
    bare = eqx.tree_at(lambda m: m.landmarks68, target, None)
    with pytest.raises(ValueError, match="no 68 landmarks"):
        transfer_database(bare, tmp_path, textures.path)
    with pytest.raises(FileNotFoundError, match="no texture database"):
        transfer_database(target, tmp_path / "out", tmp_path / "absent")
    renamed = dataclasses.replace(target, uv=target.uv * 0.5)
    with pytest.raises(ValueError, match="has others"):
        transfer_database(source, tmp_path / "out", textures.path, source=renamed)
    assert not (tmp_path / "out").exists()


def test_the_command_passes_everything_on(tmp_path, textures, monkeypatch):
    calls = []

    def transfer(*arguments, on_progress):
        calls.append(arguments)
        on_progress("textures", 2, 2)
        return textures

    monkeypatch.setattr(transferred, "transfer_database", transfer)
    command = ["database", "transfer", "--model", "kit", "-o", str(tmp_path)]
    answer = CliRunner().invoke(app, [*command, "--database", "maps", "--resolution", "64"])
    assert answer.exit_code == 0, answer.output
    assert CliRunner().invoke(app, command).exit_code == 0
    assert calls == [("kit", tmp_path, Path("maps"), 64), ("kit", tmp_path, None, None)]
    assert "2 textures" in answer.output
