"""What every model format shares: UVs, skin, landmarks, and telling files apart."""

import json
import pickle
import shutil
from pathlib import Path

import make_flame_fixture
import numpy as np
import pytest

from jaxface.io.face_models import (
    describe,
    load_model,
    read_landmarks68,
)
from jaxface.io.face_models.cylinder import cylindrical_uv
from jaxface.io.face_models.model_file import save_model
from jaxface.io.face_models.skin import generic_skin
from tests.synthetic_head import COUNT, FACES, VERTICES

FIXTURES = Path(__file__).resolve().parent / "data"


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


def _flame(path):
    np.savez(path, **make_flame_fixture.rig())
    return path


def test_load_model_tells_files_apart(tmp_path) -> None:
    flame = load_model(_flame(tmp_path / "anything.npz"))
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
