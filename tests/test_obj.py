"""OBJ files: what is written is read back, by us and by trimesh; errors name file and line."""

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from jaxface.io.formats.obj import read_obj, read_obj_vertices, triangles, write_obj

SQUARE = np.array([[0.0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0], [5, 20, 1]])
POLYGONS = np.array([[0, 1, 2, 3], [3, 2, 4, -1]])
UV = np.array([[0.0, 0], [1, 0], [1, 0.5], [0, 0.5], [0.5, 1], [0.1, 0.6]])
UV_POLYGONS = np.array([[0, 1, 2, 3], [5, 2, 4, -1]])


def test_round_trip_with_everything(tmp_path) -> None:
    texture = tmp_path / "maps" / "albedo.png"
    texture.parent.mkdir()
    texture.write_bytes(b"")
    normals = np.tile([0.0, 0.0, 1.0], (5, 1))
    path = tmp_path / "mesh.obj"
    write_obj(
        path, SQUARE, POLYGONS, uv=UV, uv_polygons=UV_POLYGONS, normals=normals,
        texture=texture, comment="CC0\nnobody",
    )  # fmt: skip
    mesh = read_obj(path)
    assert mesh.uv is not None and mesh.normals is not None
    np.testing.assert_allclose(mesh.vertices, SQUARE)
    np.testing.assert_array_equal(mesh.polygons, POLYGONS)
    np.testing.assert_allclose(mesh.uv, UV)
    np.testing.assert_array_equal(mesh.uv_polygons, UV_POLYGONS)
    np.testing.assert_allclose(mesh.normals, normals)
    assert mesh.texture == texture
    assert mesh.materials == ("skin",)
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3], [3, 2, 4]])
    np.testing.assert_array_equal(mesh.uv_faces, [[0, 1, 2], [0, 2, 3], [5, 2, 4]])
    assert path.read_text().startswith("# CC0\n# nobody\n")
    assert "map_Kd maps/albedo.png" in (tmp_path / "mesh.mtl").read_text()


def test_trimesh_reads_the_same(tmp_path) -> None:
    path = tmp_path / "mesh.obj"
    write_obj(path, SQUARE, POLYGONS)
    other = trimesh.load_mesh(path, process=False)
    np.testing.assert_allclose(other.vertices, SQUARE)
    assert len(other.faces) == 3
    np.testing.assert_allclose(other.area, 100 + 10 * np.hypot(10, 1) / 2)


@given(st.lists(st.tuples(*[st.floats(-1e3, 1e3)] * 3), min_size=3, max_size=20))
def test_vertices_survive_to_six_digits(tmp_path_factory, points) -> None:
    path = tmp_path_factory.mktemp("obj") / "mesh.obj"
    vertices = np.array(points)
    write_obj(path, vertices, np.array([[0, 1, 2]]))
    np.testing.assert_allclose(read_obj(path).vertices, vertices, rtol=1e-5)
    np.testing.assert_allclose(read_obj_vertices(path, len(vertices)), vertices, rtol=1e-5)


def test_negative_indices_polygons_and_comments(tmp_path) -> None:
    path = tmp_path / "odd.obj"
    path.write_text(
        "o thing\nv 0 0 0 1 0 0\nv 1 0 0 # a corner\nv 1 1 0\nv 0.5 2 0\nv 0 1 0\n"
        "usemtl a b\nf -5 -4 \\\n -3 -2 -1\nusemtl c\nf 1//1 2//1 3//1\ns off\n\n"
    )
    mesh = read_obj(path)
    expected = [[0, 1, 2, -1], [0, 2, 3, -1], [0, 3, 4, -1], [0, 1, 2, -1]]
    np.testing.assert_array_equal(mesh.polygons, expected)
    assert mesh.materials == ("a b", "c")
    np.testing.assert_array_equal(mesh.material, [0, 0, 0, 1])
    assert mesh.uv is None and mesh.uv_faces is None


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no vertices"),
        ("v 0 0\nf 1 1 1", "line 1.*not 3 finite numbers"),
        ("v 0 nan 0", "line 1.*not 3 finite numbers"),
        ("v 0 0 x", "line 1.*not 3 finite numbers"),
        ("v 0 0 0\nf 1 1", "line 2.*2 corners"),
        ("v 0 0 0\nf 1 1 0", "line 2.*counts from 1"),
        ("v 0 0 0\nf 1 -2 1", "line 2.*out of range"),
        ("v 0 0 0\nf 1 1 7", "names vertex 7 of only 1"),
        ("v 0 0 0\nf 1 1 a/b", "line 2.*no corner"),
        ("v 0 0 0\nvt 0 0\nf 1/1 1/1 1/2", "names texture coordinate 2 of only 1"),
        ("v 0 0 0\nvt 0 0\nf 1/1 1/1 1", "some corners"),
    ],
)
def test_malformed_files_are_named(tmp_path, text, said) -> None:
    path = tmp_path / "broken.obj"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"broken\.obj.*{said}"):
        read_obj(path)


def test_read_vertices_needs_the_topology(tmp_path) -> None:
    path = tmp_path / "mesh.obj"
    write_obj(path, SQUARE, POLYGONS)
    with pytest.raises(ValueError, match=r"mesh\.obj: 5 vertices; needed 6"):
        read_obj_vertices(path, 6)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"vertices": SQUARE * np.nan}, "vertices"),
        ({"polygons": POLYGONS + 1}, "indices 0 to 5"),
        ({"polygons": np.array([[0, 1, -1]])}, "indices -1"),
        ({"uv": UV[:2], "uv_polygons": UV_POLYGONS}, "uv_polygons has indices"),
        ({"uv": UV, "uv_polygons": UV_POLYGONS[:1]}, "uv_polygons of shape"),
        ({"normals": SQUARE[:2]}, "normals of shape"),
    ],
)
def test_bad_meshes_are_not_written(tmp_path, change, said) -> None:
    arguments = {"vertices": SQUARE, "polygons": POLYGONS, **change}
    with pytest.raises(ValueError, match=said):
        write_obj(tmp_path / "mesh.obj", **arguments)
    assert not list(tmp_path.iterdir())


def test_triangles_keeps_the_order_of_polygons() -> None:
    cut = triangles(np.array([[0, 1, 2, -1], [3, 4, 5, 6]]))
    np.testing.assert_array_equal(cut, [[0, 1, 2], [3, 4, 5], [3, 5, 6]])


def test_the_kits_own_file(data_dir) -> None:
    mesh = read_obj(data_dir / "ict" / "FaceXModel_sample" / "generic_neutral_mesh.obj")
    assert mesh.vertices.shape == (26719, 3) and mesh.polygons.shape == (26384, 4)
    assert mesh.uv is not None and mesh.uv.shape == (28911, 2)
    assert len(mesh.materials) == 12 and mesh.materials[0] == "M_Face"
