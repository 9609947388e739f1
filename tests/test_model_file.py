"""The model file: round trip, atomic writing, and clear errors for wrong files."""

import contextlib
import dataclasses
import json
import os

import jax.numpy as jnp
import numpy as np
import pytest

from jaxface.io.face_models.model_file import (
    bundled_models,
    load_bundled,
    load_model,
    read_metadata,
    save_model,
)
from jaxface.models.linear import LinearBasis, empty_basis
from jaxface.models.morphable import MorphableModel, SurfacePoints


@pytest.fixture
def model() -> MorphableModel:
    """A tetrahedron with every optional part."""
    rng = np.random.default_rng(0)
    faces = jnp.asarray([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], jnp.int32)
    quads = jnp.concatenate([faces, jnp.full((4, 1), -1)], axis=1)

    def basis(count: int, size: float) -> LinearBasis:
        columns = size * rng.normal(size=(4, 3, count))
        return LinearBasis(jnp.asarray(columns, jnp.float32), jnp.arange(1.0, count + 1))

    return MorphableModel(
        mean=jnp.asarray(50 * rng.normal(size=(4, 3)), jnp.float32),
        identity=basis(3, 4.0),
        expression=basis(2, 60.0),
        albedo_mean=jnp.asarray(rng.uniform(size=(4, 3)), jnp.float32),
        albedo=basis(2, 0.1),
        faces=faces,
        uv=jnp.asarray(rng.uniform(size=(5, 2)), jnp.float32),
        uv_faces=faces.at[3, 1].set(4),
        landmarks68=SurfacePoints(
            jnp.asarray(rng.integers(0, 4, (68, 3)), jnp.int32), jnp.full((68, 3), 1 / 3)
        ),
        landmarks468=None,
        region=jnp.asarray([0, 1, 1, 0], jnp.int32),
        name="tetra",
        region_names=("nose", "lips"),
        expression_names=("jawOpen", "eyeBlinkLeft"),
        licence="CC0",
        quads=quads,
        uv_quads=quads.at[3, 1].set(4),
    )


def rewrite(path, **changes) -> None:
    """Replace or (None) drop arrays of an .npz."""
    with np.load(path) as stored:
        arrays = dict(stored)
    for name, value in changes.items():
        if value is None:
            del arrays[name]
        else:
            arrays[name] = value
    np.savez(path, **arrays)


def test_round_trip(tmp_path, model):
    path = tmp_path / "tetra.npz"
    save_model(path, model, {"seed": 7})
    back = load_model(path)
    for name in ("mean", "albedo_mean", "faces", "uv", "uv_faces", "region", "quads", "uv_quads"):
        np.testing.assert_array_equal(getattr(back, name), getattr(model, name))
    np.testing.assert_allclose(back.identity.basis, model.identity.basis, atol=1.01e-3)
    # Half a step of the largest column, or of the finest step where that is coarser.
    bound = float(jnp.abs(model.expression.basis).max()) / 32767
    np.testing.assert_allclose(back.expression.basis, model.expression.basis, atol=bound)
    np.testing.assert_allclose(back.albedo.basis, model.albedo.basis, atol=5.1e-6)
    np.testing.assert_array_equal(back.identity.std, model.identity.std)
    assert back.landmarks68 is not None and model.landmarks68 is not None
    np.testing.assert_array_equal(back.landmarks68.vertices, model.landmarks68.vertices)
    assert back.landmarks468 is None
    for name in ("name", "region_names", "expression_names", "licence"):
        assert getattr(back, name) == getattr(model, name)
    assert back.mean.dtype == jnp.float32 and back.identity.basis.dtype == jnp.float32
    assert back.faces.dtype == jnp.int32
    assert read_metadata(path)["source"] == {"seed": 7}


def test_saving_twice_gives_the_same_model(tmp_path, model):
    """Quantisation is idempotent, so a file can be rewritten without drift."""
    save_model(tmp_path / "a.npz", model)
    once = load_model(tmp_path / "a.npz")
    save_model(tmp_path / "b.npz", once)
    twice = load_model(tmp_path / "b.npz")
    np.testing.assert_array_equal(once.identity.basis, twice.identity.basis)
    np.testing.assert_array_equal(once.expression.basis, twice.expression.basis)


def test_a_model_may_lack_modes_quads_and_landmarks(tmp_path, model):
    bare = dataclasses.replace(
        model,
        expression=empty_basis(4),
        expression_names=(),
        albedo=empty_basis(4),
        landmarks68=None,
        quads=None,
        uv_quads=None,
    )
    save_model(tmp_path / "bare.npz", bare)
    back = load_model(tmp_path / "bare.npz")
    assert back.expression.count == 0 and back.albedo.basis.shape == (4, 3, 0)
    assert back.landmarks68 is None and back.quads is None


def test_a_photos_shadows_are_written_with_their_slope(tmp_path, model):
    rng = np.random.default_rng(1)
    shadow, slope = rng.normal(size=(4, 9)), rng.normal(size=(4, 3, 9))
    shaded = dataclasses.replace(
        model, occlusion=jnp.asarray(shadow), occlusion_slope=jnp.asarray(slope)
    )
    save_model(tmp_path / "shaded.npz", shaded)
    back = load_model(tmp_path / "shaded.npz")
    assert back.occlusion is not None and back.occlusion_slope is not None
    np.testing.assert_allclose(back.occlusion, shadow, rtol=1e-3)
    np.testing.assert_allclose(back.occlusion_slope, slope, rtol=1e-3)
    rewrite(tmp_path / "shaded.npz", occlusion_slope=slope[:3])
    with pytest.raises(ValueError, match="occlusion_slope"):
        load_model(tmp_path / "shaded.npz")


def test_non_finite_models_are_not_written(tmp_path, model):
    path = tmp_path / "tetra.npz"
    save_model(path, model)
    before = path.read_bytes()
    for broken in (
        dataclasses.replace(model, mean=model.mean.at[0, 0].set(jnp.nan)),
        dataclasses.replace(
            model, albedo=LinearBasis(model.albedo.basis * jnp.inf, model.albedo.std)
        ),
    ):
        with pytest.raises(ValueError, match="non-finite"):
            save_model(path, broken)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_the_suffix_is_checked(tmp_path, model):
    with pytest.raises(ValueError, match=r"\.npz"):
        save_model(tmp_path / "tetra.mat", model)


def test_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        load_model(tmp_path / "nowhere.npz")


@pytest.mark.parametrize("keep", [0, 10, 0.3, 0.9])
def test_truncated_files_are_named(tmp_path, model, keep):
    path = tmp_path / "tetra.npz"
    save_model(path, model)
    data = path.read_bytes()
    path.write_bytes(data[: keep if isinstance(keep, int) else int(keep * len(data))])
    with pytest.raises(ValueError, match=r"tetra\.npz"):
        load_model(path)


def test_corrupt_contents_are_named(tmp_path, model):
    path = tmp_path / "tetra.npz"
    save_model(path, model)
    data = bytearray(path.read_bytes())
    start = data.index(b"mean.npy") + 60
    data[start : start + 12] = bytes(12)
    path.write_bytes(bytes(data))
    with pytest.raises(ValueError, match=r"tetra\.npz"):
        load_model(path)


@pytest.mark.parametrize("kind", ["text", "npy", "foreign"])
def test_other_formats_are_refused(tmp_path, kind):
    path = tmp_path / "other.npz"
    if kind == "text":
        path.write_text("v 0 0 0\n")
    elif kind == "npy":
        with open(path, "wb") as stream:
            np.save(stream, np.zeros(3))
    else:
        np.savez(path, weights=np.zeros(3))
    with pytest.raises(ValueError, match=r"other\.npz"):
        load_model(path)


def test_pickles_are_never_opened(tmp_path, model):
    """One would make a folder if it were; not where it is expected, nor where nothing is."""

    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "made"),)

    path = tmp_path / "tetra.npz"
    for name in ("mean", "extra"):
        save_model(path, model)
        rewrite(path, **{name: np.array([Evil()], dtype=object)})
        if name == "mean":
            with pytest.raises(ValueError, match=r"tetra\.npz"):
                load_model(path)
        else:
            with contextlib.suppress(ValueError):
                load_model(path)
        assert not (tmp_path / "made").exists()


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"mean": None}, "'mean' is missing"),
        ({"mean": np.zeros((4, 2), np.float32)}, r"'mean' has shape \(4, 2\)"),
        ({"albedo_mean": np.zeros((3, 3), np.float32)}, "'albedo_mean'"),
        ({"identity_std": np.zeros(2, np.float32)}, "'identity_std'"),
        ({"faces": np.array([[0, 1, 4]] * 4)}, r"'faces' must hold integers in \[0, 4\)"),
        ({"uv_faces": np.zeros((3, 3), int)}, "'uv_faces'"),
        ({"region": np.array([0, 1, 2, 0])}, "'region'"),
        ({"landmarks68_vertices": np.zeros((67, 3), int)}, "'landmarks68_vertices'"),
        ({"quads": np.full((4, 4), -2)}, "'quads'"),
    ],
)
def test_shapes_and_indices_are_checked(tmp_path, model, changes, complaint):
    path = tmp_path / "tetra.npz"
    save_model(path, model)
    rewrite(path, **changes)
    with pytest.raises(ValueError, match=complaint) as error:
        load_model(path)
    assert "tetra.npz" in str(error.value)


@pytest.mark.parametrize(
    ("key", "value", "complaint"),
    [
        ("schema", 99, "schema 99"),
        ("format", "something", "not a jaxface"),
        ("expression_names", ["one"], "2 expression modes but 1"),
        ("region_names", None, "region_names"),
    ],
)
def test_metadata_is_checked(tmp_path, model, key, value, complaint):
    path = tmp_path / "tetra.npz"
    save_model(path, model)
    metadata = read_metadata(path)
    metadata[key] = value
    rewrite(path, metadata=np.array(json.dumps(metadata)))
    with pytest.raises(ValueError, match=complaint):
        load_model(path)


def test_bundled_models_are_listed_and_unknown_ones_named():
    assert "makehuman" in bundled_models()
    with pytest.raises(ValueError, match="'nobody'.*makehuman"):
        load_bundled("nobody")
    with pytest.raises(ValueError, match="no bundled model"):
        load_bundled("../assets/makehuman")
