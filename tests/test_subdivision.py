"""Catmull-Clark and Loop refinement against known answers, and subdivided models."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxface.geometry.subdivision import catmull_clark, loop
from jaxface.models.linear import LinearBasis
from jaxface.models.morphable import MorphableModel, SurfacePoints
from jaxface.models.subdivide import quads_to_triangles, subdivide

CUBE = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
CUBE_QUADS = np.array(
    [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
)
OCTAHEDRON = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
OCTAHEDRON_FACES = np.array(
    [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
)


def grid(side: int) -> tuple[np.ndarray, np.ndarray]:
    """A flat (side x side)-vertex grid in z = 0 and its quads."""
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    points = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3).astype(float)
    index = np.arange(side * side).reshape(side, side)
    quads = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1)
    return points, quads.reshape(-1, 4)


def euler(quads: np.ndarray) -> int:
    edges = set()
    for face in quads:
        corners = [int(v) for v in face if v >= 0]
        edges |= {frozenset(pair) for pair in zip(corners, corners[1:] + corners[:1], strict=True)}
    return int(len(np.unique(quads[quads >= 0])) - len(edges) + len(quads))


def signed_volume(points: np.ndarray, quads: np.ndarray) -> float:
    a, b, c = (points[quads_to_triangles(quads)[:, i]] for i in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def test_cube_first_level_by_hand():
    refined = catmull_clark(CUBE_QUADS, 8)
    points = refined.matrix @ CUBE
    assert points.shape == (26, 3)
    # Corner: (F + 2R + (3 - 3) P) / 3 with F = (1,1,1)/3 and R = (2,2,2)/3 gives 5/9.
    np.testing.assert_allclose(np.abs(points[:8]), 5 / 9)
    # Edge: its ends' mean and two face points: (1, 1, 0) * 3/4.
    np.testing.assert_allclose(np.sort(np.abs(points[8:20]), axis=1), [[0, 0.75, 0.75]] * 12)
    np.testing.assert_allclose(np.sort(np.abs(points[20:]), axis=1), [[0, 0, 1]] * 6, atol=1e-15)


def test_cube_becomes_round_and_stays_closed():
    points, quads = CUBE, CUBE_QUADS
    for _ in range(4):
        refined = catmull_clark(quads, len(points))
        points, quads = refined.matrix @ points, refined.quads
    radius = np.linalg.norm(points, axis=1)
    assert radius.min() / radius.max() > 0.85  # the cube itself: 0.577
    assert euler(quads) == 2
    assert signed_volume(CUBE, CUBE_QUADS) == pytest.approx(8)
    assert 0 < signed_volume(points, quads) < 8


def test_loop_octahedron_first_level_by_hand():
    refined = loop(OCTAHEDRON_FACES, 6)
    points = refined.matrix @ OCTAHEDRON
    assert points.shape == (18, 3)
    # Valence 4: beta = (5/8 - (3/8)^2) / 4 = 31/256; the neighbours cancel.
    np.testing.assert_allclose(np.abs(points[:6]).max(1), 1 - 4 * 31 / 256)
    np.testing.assert_allclose(
        np.sort(np.abs(points[6:]), axis=1), [[0, 0.375, 0.375]] * 12, atol=1e-15
    )
    assert euler(refined.quads) == 2
    assert signed_volume(points, refined.quads) > 0


@pytest.mark.parametrize("scheme", ["catmull_clark", "loop"])
def test_boundaries_follow_their_own_cubic_spline(scheme):
    points, quads = grid(5)
    points[:, 2] = np.where((points[:, 0] % 4 == 0) | (points[:, 1] % 4 == 0), 0.0, 7.0)
    if scheme == "loop":
        refined = loop(quads_to_triangles(quads), len(points))
    else:
        refined = catmull_clark(quads, len(points))
    fine = refined.matrix @ points
    # Interior heights never leak into the boundary; a side's inner vertex is (1, 6, 1) / 8.
    coarse_border = (points[:, 0] % 4 == 0) | (points[:, 1] % 4 == 0)
    np.testing.assert_allclose(fine[:25][coarse_border, 2], 0, atol=1e-12)
    np.testing.assert_allclose(fine[2], points[2], atol=1e-12)
    np.testing.assert_allclose(fine[0], [0.125, 0.125, 0.0])


def test_flat_regular_grid_keeps_its_inside():
    points, quads = grid(5)
    fine = catmull_clark(quads, len(points)).matrix @ points
    inner = [6, 7, 8, 11, 12, 13, 16, 17, 18]
    np.testing.assert_allclose(fine[inner], points[inner], atol=1e-12)


def test_triangles_and_quads_mix():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 2, 0]])
    quads = np.array([[0, 1, 2, 3], [3, 2, 4, -1]])
    refined = catmull_clark(quads, 5)
    assert refined.quads.shape == (7, 4) and refined.quads.min() >= 0
    np.testing.assert_array_equal(refined.parent, [0, 0, 0, 0, 1, 1, 1])
    np.testing.assert_allclose((refined.matrix @ points)[-1], points[[3, 2, 4]].mean(0))
    assert euler(refined.quads) == 1


@settings(max_examples=20, deadline=None)
@given(
    st.sampled_from(["cube", "grid", "octahedron"]),
    st.lists(st.floats(-3, 3), min_size=12, max_size=12),
)
def test_rows_are_affine_weights(mesh, numbers):
    if mesh == "octahedron":
        points, refined = OCTAHEDRON, loop(OCTAHEDRON_FACES, 6)
    else:
        points, quads = (CUBE, CUBE_QUADS) if mesh == "cube" else grid(4)
        refined = catmull_clark(quads, len(points))
    linear, shift = np.array(numbers[:9]).reshape(3, 3), np.array(numbers[9:])
    for matrix in (refined.matrix, refined.linear):
        np.testing.assert_allclose(np.asarray(matrix.sum(1)).ravel(), 1.0)
        assert matrix.data.min() > 0
        np.testing.assert_allclose(
            matrix @ (points @ linear + shift), matrix @ points @ linear + shift, atol=1e-9
        )


@pytest.mark.parametrize(
    ("quads", "count", "complaint"),
    [
        (np.array([[0, 1, 2, 9]]), 4, "vertex 9"),
        (np.array([[0, 1, 2, 3], [0, 1, 4, 5], [1, 0, 6, 7]]), 8, "belongs to 3 faces"),
        (np.array([[0, 1, -1, -1]]), 4, "indices >= 0"),
        (np.zeros((2, 5), int), 4, r"shape \(q, 3\)"),
    ],
)
def test_bad_meshes_are_named(quads, count, complaint):
    with pytest.raises(ValueError, match=complaint):
        catmull_clark(quads, count)


def test_loop_wants_triangles():
    with pytest.raises(ValueError, match="triangles"):
        loop(CUBE_QUADS, 8)


def cube_model(with_quads: bool) -> MorphableModel:
    rng = np.random.default_rng(0)
    triangles = quads_to_triangles(CUBE_QUADS)
    weights = np.array([[0.2, 0.5, 0.3], [0.7, 0.2, 0.1], [0.1, 0.1, 0.8], [1.0, 0.0, 0.0]])
    picked = triangles[[0, 3, 8, 11]]
    repeats = 17
    return MorphableModel(
        mean=jnp.asarray(CUBE, jnp.float32),
        identity=LinearBasis(jnp.asarray(rng.normal(size=(8, 3, 4)), jnp.float32), jnp.ones(4)),
        expression=LinearBasis(jnp.asarray(rng.normal(size=(8, 3, 2)), jnp.float32), jnp.ones(2)),
        albedo_mean=jnp.full((8, 3), 0.5),
        albedo=LinearBasis(jnp.asarray(rng.normal(size=(8, 3, 1)), jnp.float32), jnp.ones(1)),
        faces=jnp.asarray(triangles),
        uv=jnp.asarray(CUBE[:, :2], jnp.float32),
        uv_faces=jnp.asarray(triangles),
        landmarks68=SurfacePoints(
            jnp.asarray(np.tile(picked, (repeats, 1))),
            jnp.asarray(np.tile(weights, (repeats, 1)), jnp.float32),
        ),
        landmarks468=None,
        region=jnp.asarray([0, 0, 0, 0, 1, 1, 1, 1]),
        name="cube",
        region_names=("low", "high"),
        expression_names=("a", "b"),
        licence="none",
        quads=jnp.asarray(CUBE_QUADS) if with_quads else None,
        uv_quads=jnp.asarray(CUBE_QUADS) if with_quads else None,
    )


@pytest.mark.parametrize("with_quads", [True, False])
def test_subdivided_model_commutes_with_coefficients(with_quads):
    model = cube_model(with_quads)
    fine = subdivide(model, 2)
    identity, expression = jnp.array([0.3, -1.0, 0.5, 2.0]), jnp.array([-0.4, 1.0])
    shape = np.asarray(model.shape(identity, expression))
    quads = CUBE_QUADS if with_quads else np.asarray(model.faces)
    for _ in range(2):
        refined = catmull_clark(quads, len(shape)) if with_quads else loop(quads, len(shape))
        shape = refined.matrix @ shape
        quads = refined.quads if with_quads else refined.quads[:, :3]
    np.testing.assert_allclose(fine.shape(identity, expression), shape, atol=1e-5)
    assert fine.faces.shape[0] == 16 * model.faces.shape[0]
    assert fine.mean.dtype == jnp.float32 and fine.faces.dtype == jnp.int32
    assert (fine.quads is None) == (not with_quads)
    assert fine.identity.count == 4 and fine.expression_names == ("a", "b")


@pytest.mark.parametrize("with_quads", [True, False])
def test_landmarks_keep_their_parametric_place(with_quads):
    """On the merely interpolated surface (a flat face) a landmark does not move at all."""
    model = cube_model(with_quads)
    assert model.landmarks68 is not None
    before = np.asarray(model.landmarks68(model.mean))
    fine = subdivide(model, 2)
    linear = np.asarray(model.mean)
    faces = CUBE_QUADS if with_quads else np.asarray(model.faces)
    for _ in range(2):
        refined = catmull_clark(faces, len(linear)) if with_quads else loop(faces, len(linear))
        linear = refined.linear @ linear
        faces = refined.quads if with_quads else refined.quads[:, :3]
    assert fine.landmarks68 is not None
    np.testing.assert_allclose(fine.landmarks68(jnp.asarray(linear)), before, atol=1e-5)
    weights = np.asarray(fine.landmarks68.weights)
    assert weights.min() >= 0
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-6)


def test_landmark_on_a_triangle_among_quads():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    tri = np.array([[0, 1, 2, -1]])
    rng = np.random.default_rng(1)
    weights = rng.dirichlet([1, 1, 1], size=68)
    model = MorphableModel(
        mean=jnp.asarray(points, jnp.float32),
        identity=LinearBasis(jnp.zeros((3, 3, 1)), jnp.ones(1)),
        expression=LinearBasis(jnp.zeros((3, 3, 0)), jnp.zeros(0)),
        albedo_mean=jnp.zeros((3, 3)),
        albedo=LinearBasis(jnp.zeros((3, 3, 0)), jnp.zeros(0)),
        faces=jnp.asarray(tri[:, :3]),
        uv=jnp.asarray(points[:, :2], jnp.float32),
        uv_faces=jnp.asarray(tri[:, :3]),
        landmarks68=SurfacePoints(jnp.tile(tri[:, :3], (68, 1)), jnp.asarray(weights)),
        landmarks468=None,
        region=jnp.zeros(3, jnp.int32),
        name="triangle",
        region_names=("all",),
        expression_names=(),
        licence="none",
        quads=jnp.asarray(tri),
        uv_quads=jnp.asarray(tri),
    )
    fine = subdivide(model)
    linear = catmull_clark(tri, 3).linear @ points
    assert fine.landmarks68 is not None
    places = fine.landmarks68(jnp.asarray(linear, jnp.float32))
    np.testing.assert_allclose(places, weights @ points, atol=1e-6)


def test_negative_levels_are_refused():
    with pytest.raises(ValueError, match="levels"):
        subdivide(cube_model(True), -1)


def test_landmark_off_the_mesh_is_named():
    model = cube_model(True)
    stray = SurfacePoints(jnp.tile(jnp.array([[0, 7, 3]]), (68, 1)), jnp.full((68, 3), 1 / 3))
    with pytest.raises(ValueError, match="landmark 0"):
        subdivide(dataclasses.replace(model, landmarks68=stray))
