"""Rasterising a UV layout: coverage, weights, gutter, seams."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxface.geometry.uv import seam_edges, uv_layout


def jittered_grid(cells: int, seed: int, low: float, high: float):
    """A triangulated square whose inner corners are moved at random (never folded over)."""
    rng = np.random.default_rng(seed)
    line = np.linspace(low, high, cells + 1)
    uv = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1)
    step = (high - low) / cells
    uv[1:-1, 1:-1] += rng.uniform(-0.3, 0.3, uv[1:-1, 1:-1].shape) * step
    index = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    return uv.reshape(-1, 2), faces


def texel_centres(resolution: int) -> np.ndarray:
    """(u, v) of every texel, row 0 at the top."""
    line = (np.arange(resolution) + 0.5) / resolution
    u, v = np.meshgrid(line, 1 - line)
    return np.stack([u, v], axis=-1)


@given(st.sampled_from([1, 4, 9]), st.integers(0, 10**6), st.sampled_from([3, 17, 64]))
def test_square_is_covered_without_gaps_and_weights_give_the_texel_back(cells, seed, resolution):
    uv, faces = jittered_grid(cells, seed, 0.0, 1.0)
    layout = uv_layout(uv, faces, resolution, gutter=0)
    assert bool(layout.inside.all())
    weights = np.asarray(layout.barycentric)
    assert weights.min() >= 0 and weights.sum(-1).max() <= 1 + 1e-6
    np.testing.assert_allclose(
        layout(uv.astype(np.float32), faces), texel_centres(resolution), atol=2e-6
    )


@pytest.mark.parametrize("seed", range(3))
def test_texels_belong_to_the_triangle_that_holds_them(seed):
    rng = np.random.default_rng(seed)
    uv = rng.uniform(-0.3, 1.3, (30, 2))
    faces = np.arange(30).reshape(10, 3)
    layout = uv_layout(uv, faces, 64, gutter=0)
    centres = texel_centres(64)[:, :, None]
    a, b, c = (uv[faces[:, i]] for i in range(3))

    def side(p, q):
        d = q - p
        return d[:, 0] * (centres[..., 1] - p[:, 1]) - d[:, 1] * (centres[..., 0] - p[:, 0])

    edges = np.stack([side(a, b), side(b, c), side(c, a)])
    holds = (edges > 0).all(0) | (edges < 0).all(0)
    # Overlaps: the later triangle wins.
    expected = np.where(holds.any(-1), 9 - np.argmax(holds[..., ::-1], axis=-1), -1)
    np.testing.assert_array_equal(layout.triangle, expected)


def test_orientation_row_zero_at_the_top():
    corners = np.array([[0, 0.5], [0.5, 1], [0, 1.0]])
    layout = uv_layout(corners, np.array([[0, 1, 2]]), 16, gutter=0)
    inside = np.asarray(layout.inside)
    assert inside[0, 0] and inside[:8, :8].sum() == inside.sum() > 20
    assert layout.area[0] == pytest.approx(0.125 * 256)


def test_degenerate_triangles_cover_nothing():
    uv = np.array([[0.1, 0.1], [0.9, 0.9], [0.5, 0.5], [0.2, 0.7]])
    layout = uv_layout(uv, np.array([[0, 1, 2], [3, 3, 3]]), 32)
    assert not layout.inside.any()
    assert np.isfinite(layout.barycentric).all()


@pytest.mark.parametrize("width", [0, 1, 5])
def test_gutter_repeats_the_nearest_texel(width):
    from scipy.ndimage import distance_transform_edt

    uv, faces = jittered_grid(3, 1, 0.3, 0.7)
    layout = uv_layout(uv, faces, 80, gutter=width)
    inside = np.asarray(layout.inside)
    distance = np.asarray(distance_transform_edt(~inside))
    filled = np.asarray(layout.triangle) >= 0
    assert filled[distance <= max(width - 1, 0)].all()
    assert not filled[distance > 1.42 * width].any()
    # The repeated texel is one on the rim, about as near as the nearest.
    point = np.asarray(layout(uv.astype(np.float32), faces, fill=-1.0))
    band = filled & ~inside
    reach = np.linalg.norm((point - texel_centres(80))[band] * 80, axis=-1)
    assert np.all(reach <= distance[band] * 1.2 + 0.5)


def test_udim_tiles_and_outside():
    uv, faces = jittered_grid(2, 0, 0.0, 1.0)
    moved = uv + [1.0, 0.0]
    assert not uv_layout(moved, faces, 16).inside.any()
    there = uv_layout(moved, faces, 16, tile=(1, 0))
    np.testing.assert_array_equal(there.triangle, uv_layout(uv, faces, 16).triangle)


def test_layout_is_remembered_by_content():
    uv, faces = jittered_grid(2, 0, 0.1, 0.9)
    first = uv_layout(uv, faces, 16)
    assert uv_layout(uv.copy(), faces.copy(), 16) is first
    assert uv_layout(uv, faces, 16, gutter=1) is not first


def test_seam_edges_of_a_strip_closed_to_a_ring():
    # Four quads around a tube; the texture is cut between the last and the first.
    faces, uv_faces = [], []
    for i in range(4):
        a, b, c, d = i, (i + 1) % 4, 4 + (i + 1) % 4, 4 + i
        faces += [(a, b, c), (a, c, d)]
        p, q, r, s = i, i + 1, 5 + i + 1, 5 + i
        uv_faces += [(p, q, r), (p, r, s)]
    one, other = seam_edges(np.array(faces), np.array(uv_faces))
    assert one.shape == (1, 2)
    assert {tuple(np.asarray(one[0])), tuple(np.asarray(other[0]))} == {(0, 5), (4, 9)}
    none, _ = seam_edges(np.array(faces), np.array(faces))
    assert none.shape == (0, 2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"uv": np.zeros((4, 3))}, r"uv has shape \(4, 3\)"),
        ({"uv": np.full((4, 2), np.nan)}, "NaN"),
        ({"uv_faces": np.zeros((2, 4), int)}, r"uv_faces has shape \(2, 4\)"),
        ({"uv_faces": np.array([[0, 1, 9]])}, "0..9, but uv has 4 rows"),
        ({"resolution": 0}, "resolution is 0"),
        ({"gutter": -1}, "gutter is -1"),
    ],
)
def test_errors_name_the_argument(change, message):
    arguments = {"uv": np.eye(4, 2), "uv_faces": np.array([[0, 1, 2]]), "resolution": 8} | change
    with pytest.raises(ValueError, match=message):
        uv_layout(**arguments)
