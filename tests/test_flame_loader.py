"""FLAME's files, by chumpy's own pickles too, and its joints made linear."""

import pickle
from pathlib import Path

import jax.numpy as jnp
import make_flame_fixture
import numpy as np
import pytest

from jaxface.io.face_models import load_flame, load_model
from jaxface.io.face_models.flame import joint_derivative

FIXTURES = Path(__file__).resolve().parent / "data"


def flame_file(path, rig):
    if path.suffix == ".npz":
        np.savez(path, **rig)
    else:
        path.write_bytes(pickle.dumps(rig, protocol=2))
    return path


@pytest.mark.parametrize("kind", ["chumpy", "pkl", "npz"])
def test_flame(tmp_path, kind) -> None:
    rig = make_flame_fixture.rig()
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
    rig = make_flame_fixture.rig()
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
    path = flame_file(tmp_path / "flame2023.pkl", make_flame_fixture.rig())
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
    faces = np.asarray(make_flame_fixture.rig()["f"], int)
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
    rig = {k: v for k, v in {**make_flame_fixture.rig(), **change}.items() if v is not None}
    path = flame_file(tmp_path / "broken.pkl", rig)
    with pytest.raises(ValueError, match=rf"broken\.pkl: found .*{said}"):
        load_flame(path)
