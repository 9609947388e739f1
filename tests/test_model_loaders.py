"""Every model format: a small file in exactly that format, and the formula it stands for."""

import importlib.util
import json
import pickle
import shutil
from pathlib import Path

import h5py
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.io

from jaxface.io.model_file import save_model
from jaxface.io.models import (
    describe,
    load_bfm2009,
    load_bfm_h5,
    load_flame,
    load_ict,
    load_model,
    load_surrey,
    read_landmarks68,
)
from jaxface.io.models.assemble import BLENDSHAPE_STD
from jaxface.io.models.cylinder import cylindrical_uv
from jaxface.io.models.flame import joint_derivative
from jaxface.io.models.skin import generic_skin
from jaxface.io.obj import write_obj

ROOT = Path(__file__).resolve().parent.parent
FIXTURES = ROOT / "tests" / "data"


def tool(name):
    """A module of tools/, whose formulas made the fixtures."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "tools" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


surrey_tool, flame_tool = tool("make_surrey_fixture"), tool("make_flame_fixture")


def head(count=12):
    """A ball of triangles (mm), seen from outside counter-clockwise, nose towards +z."""
    v, u = np.mgrid[0 : count // 2 + 1, 0:count].reshape(2, -1)
    latitude, longitude = np.pi * (v + 0.5) / (count / 2 + 1), 2 * np.pi * u / count
    vertices = 80 * np.stack(
        [
            np.sin(latitude) * np.sin(longitude),
            -1.2 * np.cos(latitude),
            np.sin(latitude) * np.cos(longitude),
        ],
        axis=1,
    )
    i, j = np.mgrid[0 : count // 2, 0:count].reshape(2, -1)
    a, b = i * count + j, i * count + (j + 1) % count
    faces = np.concatenate([np.stack([a, b, b + count], 1), np.stack([a, b + count, a + count], 1)])
    return vertices, faces


VERTICES, FACES = head()
COUNT = len(VERTICES)


def orthonormal(modes, seed):
    values = np.random.default_rng(seed).normal(size=(3 * COUNT, modes))
    return np.linalg.qr(values)[0].astype(np.float32)


def decode(srgb):
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def outward_volume(model):
    """Signed volume (mm^3): positive for triangles counter-clockwise from outside."""
    a, b, c = np.moveaxis(np.asarray(model.mean)[np.asarray(model.faces)], 1, 0)
    return np.einsum("fi,fi->", a, np.cross(b, c)) / 6


# Basel Face Model 2009 -------------------------------------------------------------------------


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


# Basel Face Model 2017, 2019 -------------------------------------------------------------------


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


# FLAME -----------------------------------------------------------------------------------------


def flame_file(path, rig):
    if path.suffix == ".npz":
        np.savez(path, **rig)
    else:
        path.write_bytes(pickle.dumps(rig, protocol=2))
    return path


@pytest.mark.parametrize("kind", ["chumpy", "pkl", "npz"])
def test_flame(tmp_path, kind) -> None:
    rig = flame_tool.rig()
    path = FIXTURES / "flame_chumpy.pkl"
    if kind != "chumpy":
        path = flame_file(tmp_path / f"generic_model.{kind}", rig)
    model = load_model(path)
    assert model.identity.count == 5 and model.expression.count == 102
    assert model.expression_names[99:] == ("expression099", "jawOpen", "jawLeft")
    z, e = np.linspace(-1, 2, 5), np.zeros(102)
    e[:3] = [1.0, -2.0, 0.5]
    betas = np.concatenate([z, e[:100]])
    direct = 1000 * (rig["v_template"] + rig["shapedirs"] @ betas)
    shape = model.shape(jnp.asarray(z), jnp.asarray(e))
    np.testing.assert_allclose(shape, direct, rtol=1e-5, atol=1e-3)
    assert model.albedo.count == 2 and model.landmarks68 is None


def skinned(rig, rotations):
    """Linear blend skinning with pose correctives (Li 2017, eq. 1-4), metres."""
    rest = rig["v_template"] + rig["posedirs"] @ np.concatenate(
        [(rotations[j] - np.eye(3)).ravel() for j in range(1, 5)]
    )
    centres = rig["J_regressor"] @ rig["v_template"]
    parents = [-1, 0, 1, 1, 1]
    world = []
    for j in range(5):
        local = np.eye(4)
        offset = centres[j] - (centres[parents[j]] if j else 0)
        local[:3, :3], local[:3, 3] = rotations[j], offset
        world.append(local if j == 0 else world[parents[j]] @ local)
    for j in range(5):
        world[j] = world[j].copy()
        world[j][:3, 3] -= world[j][:3, :3] @ centres[j]
    blended = np.einsum("vj,jab->vab", rig["weights"], np.stack(world))
    return np.einsum("vab,vb->va", blended[:, :3, :3], rest) + blended[:, :3, 3]


def rotation(axis, angle):
    x, y, z = axis
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


@pytest.mark.parametrize("joint", [1, 2])
@pytest.mark.parametrize("axis", np.eye(3))
def test_flame_joint_derivative_is_that_of_skinning(joint, axis) -> None:
    rig = flame_tool.rig()
    slope = joint_derivative(
        rig["v_template"], joint=joint, axis=axis, weights=rig["weights"],
        regressor=rig["J_regressor"], posedirs=rig["posedirs"], parents=np.array([-1, 0, 1, 1, 1]),
    )  # fmt: skip

    def posed(angle):
        rotations = [np.eye(3)] * 5
        rotations[joint] = rotation(axis, angle)
        return skinned(rig, rotations)

    step = 1e-5
    np.testing.assert_allclose(slope, (posed(step) - posed(-step)) / (2 * step), atol=1e-9)
    # At 0.2 rad the linear mode is wrong by at most r t^2 / 2 at distance r, plus the third order.
    centre = rig["J_regressor"][joint] @ rig["v_template"]
    reach = np.linalg.norm(rig["v_template"] - centre, axis=1).max() + 0.01
    error = np.linalg.norm(posed(0.2) - rig["v_template"] - 0.2 * slope, axis=1).max()
    assert 0 < error < 1.1 * reach * 0.2**2 / 2


def test_flame_neck_and_landmark_embeddings(tmp_path) -> None:
    path = flame_file(tmp_path / "flame2023.pkl", flame_tool.rig())
    inner, jaw = tmp_path / "flame_static_embedding.pkl", tmp_path / "flame_dynamic_embedding.npy"
    weights = np.tile([0.2, 0.3, 0.5], (51, 1))
    static = {"lmk_face_idx": np.arange(51) % 18, "lmk_b_coords": weights}
    inner.write_bytes(pickle.dumps(static))
    turns = {
        "lmk_face_idx": np.stack([np.arange(17), np.full(17, 17)]),
        "lmk_b_coords": np.tile([1.0, 0, 0], (2, 17, 1)),
    }
    np.save(jaw, turns, allow_pickle=True)
    model = load_flame(path, landmarks=(inner, jaw), neck=True)
    assert model.expression_names[-3:] == ("neckPitch", "neckYaw", "neckRoll")
    assert model.landmarks68 is not None and model.albedo.count == 5
    faces = np.asarray(flame_tool.rig()["f"], int)
    np.testing.assert_array_equal(model.landmarks68.vertices[:17], faces[:17])
    np.testing.assert_array_equal(model.landmarks68.vertices[17:35], faces[:18])
    points = np.asarray(model.landmarks68(model.mean))
    expected = np.einsum("c,lcx->lx", [0.2, 0.3, 0.5], np.asarray(model.mean)[faces[:18]])
    np.testing.assert_allclose(points[17:35], expected, rtol=1e-5, atol=1e-3)
    with pytest.warns(UserWarning, match="no vertex for points"):
        assert load_flame(path, landmarks=inner).landmarks68 is None


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"weights": None}, r"also \['weights'\]"),
        ({"v_template": np.zeros((4, 2))}, "v_template of shape"),
        ({"shapedirs": np.zeros((3, 3, 400))}, "shapedirs of shape"),
        ({"J_regressor": np.zeros((5, 3))}, "J_regressor of shape"),
        ({"f": np.array([[0, 1, 99]])}, "triangle indices from 0 to 99"),
        ({"posedirs": np.zeros(3)}, "posedirs of shape"),
    ],
)
def test_flame_wrong_parts(tmp_path, change, said) -> None:
    rig = {k: v for k, v in {**flame_tool.rig(), **change}.items() if v is not None}
    path = flame_file(tmp_path / "broken.pkl", rig)
    with pytest.raises(ValueError, match=rf"broken\.pkl: found .*{said}"):
        load_flame(path)


# Surrey, as eos stores it ----------------------------------------------------------------------


def test_surrey_full() -> None:
    model = load_model(FIXTURES / "eos_full.bin")
    vertices, triangles = surrey_tool.sheet()
    size = vertices.size
    z, e, c = np.array([1.0, -2, 0.5]), np.array([0.5, -1]), np.array([1e-3, -2e-3])
    direct = vertices.ravel() + surrey_tool.modes(size, 3, 0.1) @ (z * [20, 10, 5])
    direct = direct + 0.5 + surrey_tool.modes(size, 2, 1.3) @ (e * [3, 2])
    shape = model.shape(jnp.asarray(z), jnp.asarray(e))
    np.testing.assert_allclose(shape, direct.reshape(-1, 3), rtol=1e-5, atol=1e-4)
    srgb = np.tile([0.7, 0.5, 0.02], (size // 3, 1))
    moved = srgb + (surrey_tool.modes(size, 2, 0.7) @ (c * [0.2, 0.1])).reshape(-1, 3)
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


# ICT-FaceKit -----------------------------------------------------------------------------------


def write_kit(folder):
    """A kit of two balls: one of quads for the face, a small one behind it for the fluid."""
    folder.mkdir()
    count = 12
    vertices = np.concatenate([VERTICES / 10, VERTICES / 100 - [0, 0, 20]])
    i, j = np.mgrid[0 : count // 2, 0:count].reshape(2, -1)
    a, b = i * count + j, i * count + (j + 1) % count
    quads = np.stack([a, b, b + count, a + count], axis=1)
    uv = np.stack([np.linspace(0, 1, COUNT), np.linspace(1, 0, COUNT)], axis=1)
    # The face half in tile 0, the head half in tile 1, the fluid in tile 4.
    uv = np.concatenate([uv, uv + [1, 0], uv + [4, 0]])
    half = len(quads) // 2
    uv_quads = np.concatenate([quads[:half], quads[half:] + COUNT, quads + 2 * COUNT])
    everything = np.concatenate([quads, quads + COUNT])
    shapes = {"generic_neutral_mesh": 0, "identity000": 1, "identity001": 2, "jawOpen": 3}
    deltas = {name: 0.1 * k * np.sin(vertices + k) for name, k in shapes.items()}
    materials = ["M_Face"] * half + ["M_BackHead"] * half + ["M_LacrimalFluid"] * len(quads)
    for name, delta in deltas.items():
        write_obj(folder / f"{name}.obj", vertices + delta, everything, uv=uv, uv_polygons=uv_quads)
        lines, current, k = [], "", 0
        for line in (folder / f"{name}.obj").read_text().splitlines():
            if line.startswith("f "):
                if materials[k] != current:
                    current = materials[k]
                    lines.append(f"usemtl {current}")
                k += 1
            lines.append(line)
        (folder / f"{name}.obj").write_text("\n".join(lines))
    indices = {"expressions": ["jawOpen", "absent"], "idx_to_landmark_verts": list(range(68))}
    (folder / "vertex_indices.json").write_text(json.dumps(indices))
    return vertices, deltas


def test_ict_folder(tmp_path) -> None:
    vertices, deltas = write_kit(tmp_path / "FaceXModel")
    model = load_model(tmp_path / "FaceXModel")
    assert model.vertex_count == COUNT and "eyelids" in model.region_names
    shape = model.shape(jnp.array([1.0, -2.0]), jnp.array([0.5 / BLENDSHAPE_STD]))
    direct = vertices + deltas["identity000"] - 2 * deltas["identity001"] + 0.5 * deltas["jawOpen"]
    np.testing.assert_allclose(shape, 10 * direct[:COUNT], atol=2e-2)
    assert model.expression_names == ("jawOpen",)
    assert model.quads is not None and model.quads.shape == (72, 4)
    assert model.faces.shape == (144, 3) and outward_volume(model) > 0
    uv = np.asarray(model.uv)
    face, back = (np.asarray(model.uv_quads)[part] for part in (slice(36), slice(36, 72)))
    assert uv[face, 0].max() <= 0.75 + 1e-6 <= 0.75 + 2e-6 + uv[back, 0].min() - 0.75
    assert uv.min() >= 0 and uv.max() <= 1 and uv[:, 1].min() >= 0.25 - 1e-6
    assert model.landmarks68 is not None
    np.testing.assert_array_equal(model.landmarks68.vertices[:, 0], np.arange(68))


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda f: (f / "generic_neutral_mesh.obj").unlink(), "no generic_neutral_mesh"),
        (lambda f: (f / "vertex_indices.json").unlink(), "vertex_indices.json"),
        (lambda f: (f / "vertex_indices.json").write_text("{}"), "idx_to_landmark_verts"),
        (lambda f: [p.unlink() for p in f.glob("identity*")], r"no identity\*\.obj"),
        (lambda f: (f / "identity001.obj").write_text("v 0 0 0"), r"identity001\.obj: 1 vertices"),
        (lambda f: (f / "jawOpen.obj").write_text("v 0 0\n" * 168), r"jawOpen\.obj"),
    ],
)
def test_ict_folder_damaged(tmp_path, damage, said) -> None:
    write_kit(tmp_path / "kit")
    damage(tmp_path / "kit")
    with pytest.raises(ValueError, match=said):
        load_ict(tmp_path / "kit")


def test_ict_unknown_part(tmp_path) -> None:
    with pytest.raises(ValueError, match=r"\['nose'\] are none of"):
        load_ict(tmp_path, parts=("nose",))


def test_ict_real_folder_and_npz_agree(data_dir) -> None:
    folder = load_model(data_dir / "ict" / "FaceXModel_sample", parts=("face", "head"))
    npz = load_model(data_dir / "ict" / "ict_facehead_f16.npz")
    assert npz.identity.count == 100 and npz.expression.count == 53
    assert folder.vertex_count > npz.vertex_count == 11248
    same = np.asarray(folder.mean)[:11248]
    np.testing.assert_allclose(same, npz.mean, atol=1e-3)
    np.testing.assert_allclose(
        folder.identity.basis[:11248], npz.identity.basis[..., :3], atol=0.01
    )
    for name in folder.expression_names:
        mine = folder.expression.basis[:11248, :, folder.expression_names.index(name)]
        theirs = npz.expression.basis[..., npz.expression_names.index(name)]
        np.testing.assert_allclose(mine, theirs, atol=0.01)
    points = np.asarray(npz.landmarks68(npz.mean)) if npz.landmarks68 else np.zeros((68, 3))
    assert np.argmax(points[:, 2]) == 30 and np.argmin(points[:, 1]) == 8  # nose tip, chin
    assert points[36, 0] < points[45, 0]  # the subject's right eye has smaller x
    assert 120 < np.ptp(np.asarray(npz.mean)[:9409, 0]) < 200


def test_ict_real_eyes_and_teeth(data_dir) -> None:
    model = load_model(data_dir / "ict" / "FaceXModel_sample")
    painted = np.asarray(model.region_mask("eyes"))
    assert painted.sum() == 2 * 770  # the two eyeballs
    assert not np.any(np.asarray(model.albedo.basis)[painted])
    mean = np.asarray(model.mean)
    assert np.all(np.abs(np.abs(mean[painted, 0]) - 31) < 16)


def test_ict_real_regions_lie_where_their_names_say(data_dir) -> None:
    model = load_model(data_dir / "ict" / "ict_facehead_f16.npz")
    assert model.landmarks68 is not None
    mean, marks = np.asarray(model.mean), np.asarray(model.landmarks68(model.mean))
    middle = {
        name: mean[np.asarray(model.region_mask(name))].mean(axis=0)
        for name in ("forehead", "nose", "lips", "chin", "neck", "scalp", "eyelids")
    }
    heights = [middle[name][1] for name in ("forehead", "eyelids", "nose", "lips", "chin", "neck")]
    assert heights == sorted(heights, reverse=True)
    assert middle["scalp"][2] < middle["forehead"][2] < middle["nose"][2]
    for name, numbers in {"nose": [29, 30], "lips": [51, 57], "eyelids": [37, 47]}.items():
        vertices = np.asarray(model.landmarks68.vertices)[numbers, 0]
        assert np.all(np.asarray(model.region_mask(name))[vertices]), name
    lips = mean[np.asarray(model.region_mask("lips"))]
    assert abs(np.ptp(lips[:, 0]) / np.ptp(marks[48:60, 0]) - 1) < 0.2


# What every format shares ----------------------------------------------------------------------


def test_cylindrical_uv_has_no_triangle_across_the_seam() -> None:
    uv, uv_faces = cylindrical_uv(VERTICES, FACES)
    assert uv.min() >= 0 and uv.max() <= 1
    corners = uv[uv_faces]
    assert np.ptp(corners[..., 0], axis=1).max() < 0.5
    edges = corners[:, 1:] - corners[:, :1]
    area = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    assert np.all(area > -1e-9)  # nowhere mirrored: text on the map reads the right way round
    front = corners[FACES == int(np.argmax(VERTICES[:, 2])), 0]
    left = corners[FACES == int(np.argmax(VERTICES[:, 0])), 0]
    np.testing.assert_allclose(front, 0.5)
    assert np.all(left > 0.6)
    # A vertex keeps its height on the map whichever side of the seam a corner is on.
    height = (VERTICES[:, 1] - VERTICES[:, 1].min()) / np.ptp(VERTICES[:, 1])
    np.testing.assert_allclose(corners[..., 1], height[FACES])


def test_cylindrical_uv_of_an_open_face_fills_the_map() -> None:
    front = FACES[VERTICES[FACES][..., 2].min(axis=1) > -1e-6]
    uv, uv_faces = cylindrical_uv(np.where(VERTICES[:, 2:] < 0, 0.0, 1.0) * VERTICES, front)
    corners = uv[uv_faces]
    np.testing.assert_allclose([corners.min(), corners[..., 0].max()], [0, 1], atol=0.1)
    assert np.ptp(corners[..., 0], axis=1).max() < 0.5


def test_generic_skin_stays_a_colour_within_two_deviations() -> None:
    points = np.random.default_rng(0).normal(0, 40, (68, 3))
    points[36], points[45] = [-45, 30, 60], [45, 30, 60]
    mean, basis, std = generic_skin(VERTICES, points)
    assert basis.shape == (COUNT, 3, 5) and np.all(std == 1)
    for signs in np.array(np.meshgrid(*[[-2, 2]] * 2)).reshape(2, -1).T:
        albedo = mean + basis[..., :2] @ signs
        assert albedo.min() > 0 and albedo.max() < 1


@pytest.mark.parametrize("suffix", [".txt", ".json", ".npy", ".npz"])
def test_landmark_indices(tmp_path, suffix) -> None:
    path, indices = tmp_path / f"marks{suffix}", np.arange(68)[::-1]
    if suffix == ".txt":
        path.write_text("# comment 7\n" + "\n".join(map(str, indices)))
    elif suffix == ".json":
        path.write_text(json.dumps(indices.tolist()))
    elif suffix == ".npy":
        np.save(path, indices)
    else:
        np.savez(path, landmarks68=indices)
    points = read_landmarks68(path, FACES, COUNT)
    assert points is not None
    np.testing.assert_array_equal(points.vertices[:, 0], indices)
    with pytest.raises(ValueError, match="landmark .* on vertex 67"):
        read_landmarks68(path, FACES, 60)


def test_eos_mapping_with_contours(tmp_path) -> None:
    mapping, contours = tmp_path / "ibug_to_sfm.txt", tmp_path / "sfm_model_contours.json"
    given = [9, *range(18, 61), 62, 63, 64, 66, 67, 68]
    lines = [f"\t{number}  {number + 10} ; point {number}" for number in given]
    mapping.write_text("; Mapping from 68\nlandmarkMappings ; x\n{\n" + "\n".join(lines) + "\n}\n")
    with pytest.warns(UserWarning, match=r"no vertex for points \[1, 2, 3"):
        assert read_landmarks68(mapping, FACES, COUNT) is None
    sides = {"right_contour": list(range(17)), "left_contour": list(range(17, 34))}
    contours.write_text(json.dumps({"model_contour": sides}))
    points = read_landmarks68(mapping, FACES, COUNT, contours=contours)
    assert points is not None
    np.testing.assert_array_equal(points.vertices[:8, 0], np.arange(0, 16, 2))
    assert int(points.vertices[16, 0]) == 17 and int(points.vertices[8, 0]) == 19
    np.testing.assert_array_equal(points.vertices[60], [49 + 10, 62 + 10, 68 + 10])
    np.testing.assert_allclose(points.weights.sum(axis=1), 1, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.txt", b"1 2 3", "68 vertex indices"),
        ("a.json", b"{", "JSON"),
        ("a.json", b"{}", "68 vertex indices"),
        ("a.csv", b"", "suffix"),
        ("a.pkl", pickle.dumps({"x": 1}), "lmk_faces_idx"),
        (
            "b.pkl",
            pickle.dumps({"lmk_face_idx": np.arange(9), "lmk_b_coords": np.ones((9, 3))}),
            "51",
        ),
        ("a.npy", b"nothing", "magic"),
    ],
)
def test_landmark_files_of_no_known_form(tmp_path, name, content, said) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=rf"{name[0]}.{name[2:]}.*{said}"):
        read_landmarks68(tmp_path / name, FACES, COUNT)


def test_load_model_tells_files_apart(tmp_path) -> None:
    flame = load_model(flame_file(tmp_path / "anything.npz", flame_tool.rig()))
    save_model(tmp_path / "own.npz", flame)
    own = load_model(tmp_path / "own.npz")
    np.testing.assert_allclose(own.mean, flame.mean)
    assert own.name == flame.name == "flame-anything"
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    (tmp_path / "cut.npz").write_bytes((tmp_path / "own.npz").read_bytes()[:99])
    shutil.copy(FIXTURES / "eos_full.bin", tmp_path / "fake.mat")
    for name, said in [
        ("other.npz", r"arrays \['x'\]"),
        ("cut.npz", "no npz archive"),
        ("fake.mat", "MATLAB"),
        ("no-such-name", "no model 'no-such-name'"),
        (str(tmp_path / "missing.ply"), "no model"),
    ]:
        with pytest.raises(ValueError, match=said):
            load_model(tmp_path / name if "." in name else name)
    with pytest.raises(FileNotFoundError, match=r"absent\.mat"):
        load_model(tmp_path / "absent.mat")
    with pytest.raises(ValueError, match="do not apply"):
        load_model(tmp_path / "own.npz", landmarks="x")


def test_describe_is_json_able(tmp_path) -> None:
    facts = describe(load_model(FIXTURES / "eos_full.bin"))
    assert json.loads(json.dumps(facts)) == facts
    assert facts["vertices"] == 16 and facts["identity_modes"] == 3 and facts["landmarks68"]
    np.testing.assert_allclose(facts["identity_rms_mm"], np.sqrt((400 + 100 + 25) / 16), atol=1e-3)
