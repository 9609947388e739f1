"""Closest points, similarity transforms and non-rigid ICP."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy import sparse
from trimesh.registration import nricp_amberg

from jaxface.geometry.closest_point import TriangleTree, closest_weights
from jaxface.geometry.registration import non_rigid_icp
from jaxface.geometry.rotation import similarity_transform
from jaxface.geometry.uv import uv_layout
from jaxface.io.face_models import load_model
from jaxface.io.formats.obj import write_obj
from jaxface.pipeline.databases.scan import register_scan
from jaxface.stages.scan.transfer import transfer_texture


def sphere(level: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Unit icosphere."""
    g = (1 + 5**0.5) / 2
    v = [[s * 1, t * g, 0] for s in (-1, 1) for t in (-1, 1)]
    v = np.array(v + [[0, a, b] for a, b, _ in v] + [[b, 0, a] for a, b, _ in v], float)
    from scipy.spatial import ConvexHull

    for step in range(level + 1):
        v /= np.linalg.norm(v, axis=1, keepdims=True)
        f = ConvexHull(v).simplices
        if step < level:
            e = np.unique(np.sort(f[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
            v = np.concatenate([v, v[e].mean(axis=1)])
    a, b, c = (v[f[:, k]] for k in range(3))
    inward = np.einsum("fd,fd->f", np.cross(b - a, c - a), a) < 0
    f[inward] = f[inward][:, ::-1]
    return v, f.astype(np.int32)


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


@given(st.integers(0, 10**6), st.floats(0.05, 40.0))
def test_similarity_is_recovered(seed, scale):
    rng = np.random.default_rng(seed)
    points, rotation, shift = rng.normal(size=(8, 3)), random_rotation(rng), rng.normal(size=3) * 50
    found = similarity_transform(points, scale * points @ rotation.T + shift)
    assert found[0] == pytest.approx(scale, rel=1e-9)
    np.testing.assert_allclose(found[1], rotation, atol=1e-9)
    np.testing.assert_allclose(found[2], shift, atol=1e-8)


def test_similarity_is_the_same_on_the_host_and_in_jax(x64):
    rng = np.random.default_rng(7)
    source, target, weights = rng.normal(size=(9, 3)), rng.normal(size=(9, 3)), rng.random(9)
    for scaled in (True, False):
        host = similarity_transform(source, target, weights, scaled)
        a, b, w = (jnp.asarray(x) for x in (source, target, weights))
        device = similarity_transform(a, b, w, scaled)
        for ours, same in zip(host, device, strict=True):
            assert isinstance(ours, np.ndarray) and isinstance(same, jax.Array)
            np.testing.assert_allclose(ours, same, atol=1e-12)
        # The middles meet.
        moved = host[0] * source @ host[1].T + host[2]
        np.testing.assert_allclose(
            weights @ moved, weights @ target, atol=1e-12
        )  # the middles meet


def test_similarity_never_mirrors():
    points = np.random.default_rng(0).normal(size=(20, 3))
    _, rotation, _ = similarity_transform(points, points * [-1, 1, 1])
    assert np.linalg.det(rotation) == pytest.approx(1)


def test_similarity_says_what_is_wrong():
    with pytest.raises(ValueError, match="at least 3"):
        similarity_transform(np.eye(3)[:2], np.eye(3)[:2])
    with pytest.raises(ValueError, match="both need"):
        similarity_transform(np.eye(3), np.eye(4))
    with pytest.raises(ValueError, match="some extent"):
        similarity_transform(np.ones((4, 3)), np.random.default_rng(0).normal(size=(4, 3)))


@given(st.integers(0, 10**6))
def test_closest_weights_are_closest(seed):
    """No point of a fine sampling of the triangle is nearer than the one found."""
    rng = np.random.default_rng(seed)
    corners, point = rng.normal(size=(3, 3)), 2 * rng.normal(size=3)
    w = closest_weights(point[None], corners[None])[0]
    assert w.min() >= -1e-12 and w.sum() == pytest.approx(1)
    u, v = (x.ravel() for x in np.meshgrid(*[np.linspace(0, 1, 60)] * 2))
    inside = u + v <= 1
    samples = np.stack([1 - u - v, u, v], axis=1)[inside] @ corners
    nearest = np.linalg.norm(samples - point, axis=1).min()
    distance = np.linalg.norm(w @ corners - point)
    assert distance <= nearest + 1e-9 and distance > nearest - 0.15


def test_closest_points_are_another_implementation_s():
    rng = np.random.default_rng(6)
    corners, points = rng.normal(size=(500, 3, 3)), 2 * rng.normal(size=(500, 3))
    ours = np.einsum("qi,qid->qd", closest_weights(points, corners), corners)
    np.testing.assert_allclose(ours, trimesh.triangles.closest_point(corners, points), atol=1e-9)


def test_tree_on_a_sphere():
    vertices, faces = sphere()
    points = np.random.default_rng(1).normal(size=(300, 3))
    found = TriangleTree(vertices, faces)(points)
    radius = np.linalg.norm(points, axis=1)
    np.testing.assert_allclose(found.distance, np.abs(radius - 1), atol=0.01)
    np.testing.assert_allclose(
        np.einsum("qi,qid->qd", found.weights, vertices[faces[found.triangle]]), found.point
    )
    with pytest.raises(ValueError, match="faces is empty"):
        TriangleTree(vertices, faces[:0])


def bumpy(direction: np.ndarray) -> np.ndarray:
    """A smooth star-shaped surface: radius as a function of direction."""
    x, y, z = direction.T
    return direction * (30 + 4 * z * x + 5 * np.exp(-8 * ((x - 1) ** 2 + y**2 + z**2)))[:, None]


def test_a_sphere_becomes_a_bumpy_head():
    """Surface within a hundredth of the size, marks where they belong, triangles unfolded."""
    vertices, faces = sphere()
    fine, fine_faces = sphere(4)
    scan = bumpy(fine)
    rng = np.random.default_rng(2)
    chosen = rng.choice(len(vertices), 12, replace=False)
    marks = sparse.csr_matrix((np.ones(12), (np.arange(12), chosen)), (12, len(vertices)))
    found = non_rigid_icp(
        28 * vertices, faces, scan, fine_faces, landmarks=marks,
        landmark_targets=bumpy(vertices[chosen]), stiffness=(40, 10, 3, 1),
    )  # fmt: skip
    assert np.median(found.distance) < 0.02 and found.distance.max() < 0.6
    assert found.matched.mean() > 0.95
    error = np.linalg.norm(found.vertices[chosen] - bumpy(vertices[chosen]), axis=1)
    assert error.max() < 1.0
    a, b, c = (found.vertices[faces[:, k]] for k in range(3))
    outward = np.einsum("fd,fd->f", np.cross(b - a, c - a), a)
    assert (outward > 0).all()


def test_as_near_as_an_independent_implementation():
    """Trimesh's non-rigid ICP of the same paper, on the same problem: both reach the surface."""
    vertices, faces = sphere(2)
    fine, fine_faces = sphere(4)
    scan, chosen = bumpy(fine), np.random.default_rng(2).choice(len(vertices), 12, replace=False)
    marks = sparse.csr_matrix((np.ones(12), (np.arange(12), chosen)), (12, len(vertices)))
    targets = bumpy(vertices[chosen])
    ours = non_rigid_icp(
        28 * vertices, faces, scan, fine_faces, landmarks=marks, landmark_targets=targets,
        stiffness=(40, 10, 3, 1),
    ).vertices  # fmt: skip
    theirs = nricp_amberg(
        trimesh.Trimesh(28 * vertices, faces, process=False),
        trimesh.Trimesh(scan, fine_faces, process=False),
        source_landmarks=chosen, target_positions=targets, use_faces=False,
        distance_threshold=0.3,
        steps=[(0.1, 20, 0.5, 10), (0.02, 10, 0.5, 10), (0.01, 5, 0.5, 10), (0.005, 2, 0, 10)],
    )  # fmt: skip
    surface = TriangleTree(scan, fine_faces)
    near, far = surface(ours).distance, surface(np.asarray(theirs)).distance
    assert far.max() < 0.2  # of 60: the oracle solves this problem
    assert near.max() < 0.05 and near.mean() <= far.mean()
    for found in (ours, theirs):
        assert np.linalg.norm(found[chosen] - targets, axis=1).max() < 0.05
    # Between the landmarks neither lets the sheet slide, so they agree on where a vertex goes.
    assert np.median(np.linalg.norm(ours - theirs, axis=1)) < 0.8


def test_a_stiff_template_stays_affine():
    vertices, faces = sphere(2)
    stretched = vertices @ np.diag([1.0, 1.3, 0.9]).T
    found = non_rigid_icp(vertices, faces, stretched, faces, stiffness=(1e4,), steps=30, reach=1.0)
    fitted = np.linalg.lstsq(np.c_[vertices, np.ones(len(vertices))], found.vertices, rcond=None)
    residual = np.c_[vertices, np.ones(len(vertices))] @ fitted[0] - found.vertices
    assert np.abs(residual).max() < 1e-3
    assert np.median(found.distance) < 0.05


def test_what_the_scan_lacks_is_carried_along():
    """Half a scan: its rim attracts nothing, and the far half keeps its shape."""
    vertices, faces = sphere(2)
    fine, fine_faces = sphere(4)
    half = fine_faces[(fine[fine_faces][:, :, 0] > 0).all(axis=1)]
    found = non_rigid_icp(20 * vertices, faces, 21 * fine, half, stiffness=(20, 5), reach=8.0)
    far = vertices[:, 0] < -0.5
    assert not found.matched[far].any()
    radius = np.linalg.norm(found.vertices[far], axis=1)
    assert radius.min() > 18 and radius.max() < 24


def test_icp_says_what_is_wrong():
    vertices, faces = sphere(1)
    with pytest.raises(ValueError, match="stiffness is empty"):
        non_rigid_icp(vertices, faces, vertices, faces, stiffness=())
    with pytest.raises(ValueError, match="belong together"):
        non_rigid_icp(vertices, faces, vertices, faces, landmark_targets=np.zeros((1, 3)))
    with pytest.raises(ValueError, match="vertex_weights has shape"):
        non_rigid_icp(vertices, faces, vertices, faces, vertex_weights=np.ones(3))


@pytest.mark.slow
def test_a_head_of_the_model_is_found_again(tmp_path):
    """A random identity as the scan, in other units and another place: vertex to vertex."""
    model = load_model("makehuman")
    z = np.random.default_rng(4).normal(size=model.identity.count) * 0.8
    shape = np.asarray(model.shape(jnp.asarray(z), jnp.zeros(model.expression.count)))
    moved = 0.02 * shape + [3.0, -1.0, 0.5]
    write_obj(
        tmp_path / "scan.obj", moved, np.asarray(model.faces),
        uv=np.asarray(model.uv), uv_polygons=np.asarray(model.uv_faces),
    )  # fmt: skip
    assert model.landmarks68 is not None
    marks = np.asarray(model.landmarks68(jnp.asarray(moved)))
    (tmp_path / "marks.json").write_text(json.dumps({
        "schema": "jaxface-landmarks/1", "scheme": "ibug68", "image_size": None,
        "points": marks.tolist(),
    }))  # fmt: skip
    found = register_scan(tmp_path / "scan.obj", model=model, landmarks=tmp_path / "marks.json")
    assert found.summary()["median_mm"] < 0.2 and found.summary()["p95_mm"] < 1.5
    face = np.asarray(model.region_mask("cheeks", "forehead", "nose", "chin"))
    error = np.linalg.norm(found.vertices - found.scan_vertices, axis=1)[face]
    assert np.median(error) < 2.0
    # A map that tells the texel's own coordinates comes over as the identity.
    size = 128
    u, v = np.meshgrid((np.arange(size) + 0.5) / size, 1 - (np.arange(size) + 0.5) / size)
    layout = uv_layout(model.uv, model.uv_faces, size)
    over = transfer_texture(found, np.stack([u, v], -1).astype(np.float32), model, layout)
    cheeks = np.asarray(layout(face[:, None].astype(np.float32), model.faces)[..., 0]) > 0.99
    cheeks &= np.asarray(over.known) > 0
    moved_by = np.linalg.norm(np.asarray(over.texture) - np.stack([u, v], -1), axis=-1)[cheeks]
    assert cheeks.sum() > 300 and np.median(moved_by) < 0.01


@pytest.mark.slow
def test_a_real_scan(data_dir):
    folder = data_dir / "lps_head"
    if not (folder / "head.obj").is_file():
        pytest.skip(f"no head scan in {folder}")
    found = register_scan(folder / "head.obj", folder / "head_diffuse.jpg")
    summary = found.summary()
    assert 45 < summary["mm_per_unit"] < 54
    assert summary["median_mm"] < 0.2 and summary["p95_mm"] < 2.5
