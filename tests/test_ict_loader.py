"""ICT-FaceKit: a made-up kit in its format, and the real one where it is present."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from jaxface.io.face_models import (
    load_ict,
    load_model,
)
from jaxface.io.face_models.assemble import BLENDSHAPE_STD
from jaxface.io.formats.obj import write_obj
from tests.synthetic_head import COUNT, VERTICES, outward_volume


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
