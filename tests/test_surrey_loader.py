"""Models in eos's binary format, in files that eos itself wrote."""

from pathlib import Path

import jax.numpy as jnp
import make_surrey_fixture
import numpy as np
import pytest

from jaxface.io.face_models import load_model, load_surrey
from jaxface.io.face_models.assemble import BLENDSHAPE_STD
from tests.synthetic_head import decode

FIXTURES = Path(__file__).resolve().parent / "data"


def test_surrey_full() -> None:
    model = load_model(FIXTURES / "eos_full.bin")
    vertices, triangles = make_surrey_fixture.sheet()
    size = vertices.size
    z, e, c = np.array([1.0, -2, 0.5]), np.array([0.5, -1]), np.array([1e-3, -2e-3])
    direct = vertices.ravel() + make_surrey_fixture.modes(size, 3, 0.1) @ (z * [20, 10, 5])
    direct = direct + 0.5 + make_surrey_fixture.modes(size, 2, 1.3) @ (e * [3, 2])
    shape = model.shape(jnp.asarray(z), jnp.asarray(e))
    np.testing.assert_allclose(shape, direct.reshape(-1, 3), rtol=1e-5, atol=1e-4)
    srgb = np.tile([0.7, 0.5, 0.02], (size // 3, 1))
    moved = srgb + (make_surrey_fixture.modes(size, 2, 0.7) @ (c * [0.2, 0.1])).reshape(-1, 3)
    np.testing.assert_allclose(model.albedo_mean, decode(srgb), atol=1e-6)
    np.testing.assert_allclose(
        model.reflectance(jnp.asarray(c)) - model.albedo_mean,
        decode(moved) - decode(srgb),
        atol=1e-7,
    )
    np.testing.assert_array_equal(model.faces, triangles)
    uv = np.stack([vertices[:, 0] / 60, 1 - 0.25 * vertices[:, 1] / 60], axis=1)
    np.testing.assert_allclose(model.uv, uv, atol=1e-6)
    assert model.landmarks68 is not None
    expected = [number * 5 % 16 for number in range(1, 69)]
    np.testing.assert_array_equal(model.landmarks68.vertices[:, 0], expected)


def test_surrey_blendshapes_inside_and_beside_the_model() -> None:
    inside = load_surrey(FIXTURES / "eos_blendshapes.bin")
    beside = load_surrey(
        FIXTURES / "eos_shape_only.bin", blendshapes=FIXTURES / "eos_expressions.bin"
    )
    size = inside.vertex_count * 3
    for model in (inside, beside):
        assert model.expression_names == ("surprise", "joy")
        whole = model.expression(jnp.array([1.0, 0.0]) / BLENDSHAPE_STD)
        np.testing.assert_allclose(whole, np.arange(size).reshape(-1, 3), rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(inside.uv_faces, inside.faces)
    assert beside.albedo.count == 2
    assert load_surrey(FIXTURES / "eos_shape_only.bin").expression.count == 0


@pytest.mark.parametrize("cut", [2, 6, 40, 300, 2000, 4100, -1])
def test_surrey_cut_short(tmp_path, cut) -> None:
    path = tmp_path / "cut.bin"
    path.write_bytes((FIXTURES / "eos_full.bin").read_bytes()[:cut])
    with pytest.raises(ValueError, match=r"cut\.bin: found .*needed .*"):
        load_surrey(path)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"\x00\x00\x00\x00" * 9, "class version 0"),
        (b"PNG and so on, nothing of eos", "class version"),
        ((FIXTURES / "eos_full.bin").read_bytes() + b"\0", "1 bytes after the last value"),
    ],
)
def test_surrey_foreign_files(tmp_path, data, said) -> None:
    (tmp_path / "foreign.bin").write_bytes(data)
    with pytest.raises(ValueError, match=rf"foreign\.bin: found .*{said}"):
        load_surrey(tmp_path / "foreign.bin")
