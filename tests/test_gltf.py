"""GLB files: what is in them is what was given, by pygltflib's and trimesh's readers."""

import io
from typing import Any

import jax.numpy as jnp
import numpy as np
import pygltflib
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from jaxface.geometry.camera import Pose
from jaxface.geometry.rotation import rotation_matrix
from jaxface.io.formats.gltf import GlbCamera, vertex_normals, write_glb

# A tetrahedron (mm) whose base is unwrapped on its own: vertices 0-2 have two uvs each.
VERTICES = np.array([[0.0, 0, 0], [100, 0, 0], [0, 100, 0], [0, 0, 100]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
UV = np.array([[0.0, 0], [1, 0], [0, 1], [0.25, 0.25], [0.5, 0.5], [0.75, 0.5], [0.5, 0.75]])
UV_FACES = np.array([[4, 6, 5], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
TYPES = {5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}


def png(colour=(200, 150, 120)) -> bytes:
    stream = io.BytesIO()
    Image.new("RGB", (4, 4), colour).save(stream, "png")
    return stream.getvalue()


def read_view(document, index, dtype, offset=0) -> np.ndarray:
    view = document.bufferViews[index]
    start = (view.byteOffset or 0) + offset
    return np.frombuffer(document.binary_blob()[start : start + view.byteLength], dtype)


def read_accessor(document, index) -> np.ndarray:
    accessor = document.accessors[index]
    width = WIDTHS[accessor.type]
    if accessor.bufferView is None:
        values = np.zeros((accessor.count, width), TYPES[accessor.componentType])
    else:
        dtype = TYPES[accessor.componentType]
        values = read_view(document, accessor.bufferView, dtype).reshape(-1, width).copy()
    if accessor.sparse is not None:
        sparse = accessor.sparse
        where = read_view(document, sparse.indices.bufferView, TYPES[sparse.indices.componentType])
        moved = read_view(document, sparse.values.bufferView, "<f4").reshape(-1, width)
        assert len(where) == len(moved) == sparse.count and np.all(np.diff(where.astype(int)) > 0)
        values[where] = moved
    assert len(values) == accessor.count
    return values


def load(path):
    document = pygltflib.GLTF2().load(str(path))
    assert document is not None
    return document


def test_units_uv_seams_and_texture(tmp_path) -> None:
    path = tmp_path / "face.glb"
    write_glb(path, VERTICES, FACES, uv=UV, uv_faces=UV_FACES, texture=png(), licence="CC0")
    document = load(path)
    primitive = document.meshes[0].primitives[0]
    position = read_accessor(document, primitive.attributes.POSITION)
    uv = read_accessor(document, primitive.attributes.TEXCOORD_0)
    normal = read_accessor(document, primitive.attributes.NORMAL)
    index = read_accessor(document, primitive.indices).reshape(-1, 3)
    assert len(position) == 7  # three of the four vertices are split
    np.testing.assert_allclose(position[index], VERTICES[FACES] / 1000)
    np.testing.assert_allclose(uv[index], UV[UV_FACES] * [1, -1] + [0, 1], atol=1e-7)
    expected = vertex_normals(VERTICES, FACES)
    np.testing.assert_allclose(normal[index], expected[FACES], atol=1e-6)
    assert primitive.attributes.POSITION is not None
    accessor = document.accessors[primitive.attributes.POSITION]
    np.testing.assert_allclose(accessor.max, [0.1] * 3)
    np.testing.assert_allclose(accessor.min, [0.0] * 3)
    [image] = document.images
    data = read_view(document, image.bufferView, "u1").tobytes()
    assert image.mimeType == "image/png" and data == png()
    surface = document.materials[0].pbrMetallicRoughness
    assert surface.metallicFactor == 0 and surface.roughnessFactor == 0.6
    assert document.asset.copyright == "CC0"


def test_trimesh_reads_mesh_texture_and_pose(tmp_path) -> None:
    path = tmp_path / "face.glb"
    rotation = np.array([0.2, -0.5, 0.1])
    pose = Pose(jnp.asarray(rotation), jnp.array([10.0, 20.0, -600.0]))
    write_glb(path, VERTICES, FACES, uv=UV, uv_faces=UV_FACES, texture=png(), pose=pose)
    [mesh] = trimesh.load_scene(path, process=False).dump()
    assert isinstance(mesh, trimesh.Trimesh)
    visual: Any = mesh.visual
    matrix = np.asarray(rotation_matrix(jnp.asarray(rotation)))
    placed = (VERTICES @ matrix.T + [10, 20, -600]) / 1000
    np.testing.assert_allclose(mesh.triangles, placed[FACES], atol=1e-6)
    assert mesh.is_winding_consistent
    np.testing.assert_allclose(np.asarray(visual.uv)[mesh.faces], UV[UV_FACES], atol=1e-6)
    assert visual.material.baseColorTexture.getpixel((1, 1)) == (200, 150, 120)


@given(st.integers(0, 4), st.integers(0, 2**32 - 1))
def test_morphs_are_the_displacements_given(tmp_path_factory, count, seed) -> None:
    """Sparse, dense and empty targets alike, followed across the seam's duplicates."""
    path = tmp_path_factory.mktemp("glb") / "face.glb"
    generator = np.random.default_rng(seed)
    moving = generator.random((count, 4, 1)) < generator.random()
    deltas = generator.normal(0, 20, (count, 4, 3)) * moving
    names = [f"shape {i}" for i in range(count)]
    weights = {names[-1]: 0.25} if names else {}
    write_glb(
        path, VERTICES, FACES, uv=UV, uv_faces=UV_FACES,
        morphs=dict(zip(names, deltas, strict=True)), weights=weights,
    )  # fmt: skip
    document = load(path)
    mesh = document.meshes[0]
    primitive = mesh.primitives[0]
    if not names:
        assert not primitive.targets and not mesh.weights
        return
    assert mesh.extras["targetNames"] == names
    assert mesh.weights == [0.0] * (count - 1) + [0.25]
    index = read_accessor(document, primitive.indices).reshape(-1, 3)
    for target, delta in zip(primitive.targets, deltas, strict=True):
        accessor = target["POSITION"] if isinstance(target, dict) else target.POSITION
        values = read_accessor(document, accessor)
        np.testing.assert_allclose(values[index], delta[FACES] / 1000, atol=1.01e-6)
        np.testing.assert_allclose(document.accessors[accessor].max, values.max(axis=0))
        np.testing.assert_allclose(document.accessors[accessor].min, values.min(axis=0))


def test_sparse_targets_make_the_file_small(tmp_path) -> None:
    side = 60
    y, x = np.mgrid[0:side, 0:side].reshape(2, -1)
    vertices = np.stack([x, y, 0 * x], axis=1).astype(float)
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    faces = np.stack([corner, corner + 1, corner + side], axis=1)
    few = np.zeros_like(vertices)
    few[:100] = 1.0
    write_glb(tmp_path / "a.glb", vertices, faces)
    write_glb(tmp_path / "b.glb", vertices, faces, morphs={f"m{i}": few for i in range(10)})
    grown = (tmp_path / "b.glb").stat().st_size - (tmp_path / "a.glb").stat().st_size
    assert grown < 10 * (100 * 14 + 700)


def test_camera_sees_the_photo(tmp_path) -> None:
    path = tmp_path / "face.glb"
    write_glb(path, VERTICES, FACES, camera=GlbCamera(focal=500.0, height=1000, width=500))
    document = load(path)
    lens = document.cameras[0].perspective
    assert lens is not None and lens.aspectRatio is not None
    np.testing.assert_allclose(lens.yfov, np.pi / 2)
    np.testing.assert_allclose(lens.aspectRatio, 0.5)
    assert document.scenes[0].nodes == [0, 1] and document.nodes[1].camera == 0


def test_vertex_colours_are_linear_light(tmp_path) -> None:
    path = tmp_path / "face.glb"
    colours = np.array([[0.5, 0.25, 0.125]] * 4)
    write_glb(path, VERTICES, FACES, colours=colours, extras={"fit": {"version": 1}})
    document = load(path)
    attributes = document.meshes[0].primitives[0].attributes
    np.testing.assert_allclose(read_accessor(document, attributes.COLOR_0), colours)
    assert document.nodes[0].extras == {"fit": {"version": 1}}


def test_large_meshes_use_wide_indices(tmp_path) -> None:
    path = tmp_path / "big.glb"
    count = 70_000
    vertices = np.random.default_rng(0).normal(size=(count, 3))
    faces = np.array([[0, 1, count - 1]])
    delta = np.zeros((count, 3))
    delta[count - 1] = 5.0
    write_glb(path, vertices, faces, morphs={"last": delta})
    document = load(path)
    primitive = document.meshes[0].primitives[0]
    np.testing.assert_array_equal(read_accessor(document, primitive.indices).ravel(), faces[0])
    target = (primitive.targets or [])[0]
    accessor = target["POSITION"] if isinstance(target, dict) else target.POSITION
    np.testing.assert_allclose(read_accessor(document, accessor), delta / 1000)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"vertices": VERTICES + np.inf}, "vertices has NaN or Inf"),
        ({"vertices": VERTICES[:, :2]}, "vertices of shape"),
        ({"faces": FACES + 1}, "indices 1 to 4"),
        ({"faces": FACES.astype(float)}, "float64"),
        ({"uv": UV[:5], "uv_faces": UV_FACES}, "uv_faces has indices"),
        ({"uv": UV, "uv_faces": UV_FACES[:2]}, "uv_faces of shape"),
        ({"morphs": {"smile": VERTICES[:2]}}, "smile of shape"),
        ({"weights": {"smile": 1.0}}, r"weights name \['smile'\]"),
        ({"uv": UV, "uv_faces": UV_FACES, "texture": b"GIF89a"}, "PNG or JPEG"),
    ],
)
def test_bad_input_is_named_and_nothing_written(tmp_path, change, said) -> None:
    arguments = {"vertices": VERTICES, "faces": FACES, **change}
    with pytest.raises(ValueError, match=said):
        write_glb(tmp_path / "face.glb", **arguments)
    assert not list(tmp_path.iterdir())


def test_normals_are_finite_at_lonely_and_degenerate_vertices() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [9, 9, 9]])
    normals = vertex_normals(vertices, np.array([[0, 1, 2]]))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
