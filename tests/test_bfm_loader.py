"""The Basel Face Model's files of 2009, 2017 and 2019, and the formulas they stand for."""

import json

import h5py
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.io

from jaxface.io.face_models import (
    load_bfm2009,
    load_bfm_h5,
    load_model,
)
from tests.synthetic_head import COUNT, FACES, VERTICES, decode, orthonormal, outward_volume


def bfm2009():
    generator = np.random.default_rng(3)
    segments = np.zeros((COUNT, 4), np.float32)
    segments[np.arange(COUNT), np.arange(COUNT) % 4] = 1
    return {
        "shapeMU": (1000 * VERTICES).reshape(-1, 1).astype(np.float32),
        "shapePC": orthonormal(5, 1),
        "shapeEV": 1000 * np.array([50, 40, 30, 20, 10], np.float32)[:, None],
        "texMU": generator.uniform(40, 220, (3 * COUNT, 1)).astype(np.float32),
        "texPC": orthonormal(4, 2),
        "texEV": np.array([300, 200, 100, 50], np.float32)[:, None],
        "tl": FACES[:, ::-1].astype(np.float64) + 1,  # the file's triangles are clockwise
        "segbin": segments,
    }


def write_mat73(path, content):
    """MATLAB 7.3 is HDF5 with a 512-byte header and the axes in reverse."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for key, value in content.items():
            file[key] = value.T
    with open(path, "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(512, b" "))


@pytest.mark.parametrize("version", ["5", "7.3"])
def test_bfm2009(tmp_path, version) -> None:
    path, content = tmp_path / "01_MorphableModel.mat", bfm2009()
    if version == "5":
        scipy.io.savemat(path, content)
    else:
        write_mat73(path, content)
    model = load_model(path)
    z = np.array([1.0, -2.0, 0.5, 0.0, 1.5])
    direct = content["shapeMU"].ravel() + content["shapePC"] @ (z * content["shapeEV"].ravel())
    shape = model.shape(jnp.asarray(z), jnp.zeros(0))
    np.testing.assert_allclose(shape, direct.reshape(-1, 3) / 1000, rtol=1e-5, atol=1e-3)
    np.testing.assert_allclose(model.identity.std, [50, 40, 30, 20, 10])
    assert outward_volume(model) > 0
    assert np.array_equal(model.faces, FACES)
    srgb = content["texMU"].reshape(-1, 3) / 255
    np.testing.assert_allclose(model.albedo_mean, decode(srgb), atol=1e-6)
    small = 1e-3 * np.array([1.0, -1.0, 0.5, 2.0])
    moved = srgb + (content["texPC"] @ (small * content["texEV"].ravel())).reshape(-1, 3) / 255
    np.testing.assert_allclose(
        model.reflectance(jnp.asarray(small)) - model.albedo_mean,
        decode(moved) - decode(srgb),
        atol=2e-6,
    )
    assert model.region_names == ("segment1", "segment2", "segment3", "segment4")
    assert np.array_equal(model.region, np.arange(COUNT) % 4)
    assert model.expression.count == 0 and model.landmarks68 is None


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"shapePC": None}, r"also \['shapePC'\]"),
        ({"shapeEV": np.ones((3, 1))}, "one a mode"),
        ({"shapeMU": np.ones((3 * COUNT - 3, 1))}, f"{COUNT - 1}"),
        ({"shapePC": np.ones((7, 5))}, "shapePC of shape"),
        ({"texMU": np.full((3 * COUNT, 1), np.nan)}, "albedo"),
        ({"tl": FACES + 2.0 + COUNT}, "triangle indices"),
        ({"segbin": np.ones((3, 4))}, "segbin of shape"),
    ],
)
def test_bfm2009_wrong_parts(tmp_path, change, said) -> None:
    content = {key: value for key, value in {**bfm2009(), **change}.items() if value is not None}
    scipy.io.savemat(tmp_path / "broken.mat", content)
    with pytest.raises(ValueError, match=rf"broken\.mat: found (?=.*needed ).*{said}"):
        load_bfm2009(tmp_path / "broken.mat")


def write_bfm_h5(path, *, scaled=False, colour=True, expression=True, landmarks=()):
    parts = {"shape": (VERTICES.ravel(), 3, 11), "expression": (np.full(3 * COUNT, 0.25), 2, 12)}
    parts["color"] = (np.full(3 * COUNT, 0.6), 2, 13)
    variances = {"shape": [900, 400, 100], "expression": [25, 9], "color": [0.04, 0.01]}
    arrays = {}
    with h5py.File(path, "w") as file:
        for name, (mean, modes, seed) in parts.items():
            if (name == "color" and not colour) or (name == "expression" and not expression):
                continue
            variance = np.array(variances[name], np.float32)
            basis = orthonormal(modes, seed)
            group = file.create_group(name)
            group["model/mean"] = mean.astype(np.float32)
            group["model/pcaBasis"] = basis * np.sqrt(variance) if scaled else basis
            group["model/pcaVariance"] = variance
            group["model/noiseVariance"] = 0.0
            group["representer/points"] = VERTICES.T.astype(np.float32)
            group["representer/cells"] = FACES.T.astype(np.int32)
            group["version/majorVersion"], group["version/minorVersion"] = 0, 9
            arrays[name] = mean, basis, np.sqrt(variance)
        text = json.dumps([{"id": k, "coordinates": list(map(float, p))} for k, p in landmarks])
        file["metadata/landmarks/json"] = np.frombuffer(text.encode(), np.int8)
    return arrays


@pytest.mark.parametrize("scaled", [False, True])
def test_bfm_h5(tmp_path, scaled) -> None:
    path = tmp_path / "model2019_fullHead.h5"
    arrays = write_bfm_h5(path, scaled=scaled, landmarks=[("center.nose.tip", VERTICES[3])])
    model = load_model(path)
    z, e = np.array([0.5, -1, 2]), np.array([1.0, -1.5])
    direct = np.zeros(3 * COUNT)
    for (mean, basis, std), c in ((arrays["shape"], z), (arrays["expression"], e)):
        direct = direct + mean + basis @ (c * std)
    shape = model.shape(jnp.asarray(z), jnp.asarray(e))
    np.testing.assert_allclose(shape, direct.reshape(-1, 3), rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(model.expression.std, [5, 3], rtol=1e-6)
    np.testing.assert_allclose(model.albedo_mean, decode(np.full((COUNT, 3), 0.6)), atol=1e-6)
    np.testing.assert_allclose(model.albedo.std, [0.2, 0.1], rtol=1e-6)
    assert model.landmarks68 is None  # anatomical names are not the 68 numbers
    assert "2019" in model.licence and outward_volume(model) > 0


def test_bfm_h5_shape_alone_with_numbered_landmarks(tmp_path) -> None:
    path = tmp_path / "model2017-1_bfm_nomouth.h5"
    marks = [(str(i + 1), VERTICES[i] + 0.5) for i in range(68)]
    write_bfm_h5(path, colour=False, expression=False, landmarks=marks)
    model = load_model(path)
    assert model.landmarks68 is not None
    np.testing.assert_array_equal(model.landmarks68.vertices[:, 0], np.arange(68))
    assert model.expression.count == 0 and model.albedo.count == 5  # the generic skin


def test_bfm_h5_wrong_files(tmp_path) -> None:
    path = tmp_path / "broken.h5"
    path.write_bytes(b"not HDF5")
    with pytest.raises(ValueError, match=r"broken\.h5.*no HDF5 signature"):
        load_bfm_h5(path)
    write_bfm_h5(path)
    with h5py.File(path, "r+") as file:
        del file["expression/model/pcaVariance"]
    with pytest.raises(ValueError, match=r"broken\.h5.*expression/model/pcaVariance"):
        load_bfm_h5(path)
    with h5py.File(path, "r+") as file:
        del file["expression"]
        del file["shape/representer"]
    with pytest.raises(ValueError, match=r"broken\.h5.*shape/representer/cells"):
        load_bfm_h5(path)
    with h5py.File(path, "w") as file:
        file["other"] = np.zeros(3)
    with pytest.raises(ValueError, match=r"broken\.h5.*shape/model"):
        load_bfm_h5(path)
