"""The rasteriser against a brute-force float64 loop, its rules, and its derivatives."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxface.geometry.camera import Camera
from jaxface.render import zbuffer
from jaxface.render._interpolate import interpolate
from jaxface.render._rasterize import barycentrics, rasterize
from jaxface.render.coverage import TILE_PIXELS, pixel_block, tile_bits, tile_shape

HEIGHT, WIDTH = 45, 61


def brute_force(screen, faces, height, width, cull=False, near=0.0):
    """Ids, weights, depths by a loop over triangles, and where rounding cannot change them.

    A pixel is ``clear`` if no edge function and no difference of depths there lies within a few
    float32 roundings of zero.
    """
    screen, faces = np.asarray(screen, np.float64), np.asarray(faces)
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    ids = np.full((height, width), -1)
    depth = np.full((height, width), np.inf)
    weights = np.zeros((height, width, 3))
    clear = np.ones((height, width), bool)
    rounding = 3e-6
    for t, face in enumerate(faces):
        corner = screen[face]
        if not np.isfinite(corner).all() or (corner[:, 2] <= near).any():
            continue
        e = np.zeros((3, height, width))
        positive, negative = np.ones((2, height, width), bool)
        low, high = np.full((height, width), np.inf), np.full((height, width), -np.inf)
        for i in range(3):
            a, b = corner[(i + 1) % 3, :2], corner[(i + 2) % 3, :2]
            e[i] = (a[0] - x) * (b[1] - y) - (a[1] - y) * (b[0] - x)
            d = b - a
            top_left = d[1] < 0 or (d[1] == 0 and d[0] > 0)
            bottom_right = d[1] > 0 or (d[1] == 0 and d[0] < 0)
            positive = positive & ((e[i] > 0) | ((e[i] == 0) & top_left))
            negative = negative & ((e[i] < 0) | ((e[i] == 0) & bottom_right))
            reach = np.hypot(a[0] - x, a[1] - y) * np.hypot(b[0] - x, b[1] - y) + 1e-30
            low, high = np.minimum(low, e[i] / reach), np.maximum(high, e[i] / reach)
        inside = negative if cull else positive | negative
        sure = (low > rounding) | (high < -rounding)
        possible = (low > -rounding) | (high < rounding)
        if len(np.unique(corner[:, :2], axis=0)) == 3:
            clear &= sure | ~possible
        if not inside.any():
            continue
        area = e.sum(axis=0)
        area = np.where(inside, area, 1.0)
        inverse = sum(e[i] / corner[i, 2] for i in range(3))
        z = np.where(inside, area / np.where(inside, inverse, 1.0), np.inf)
        both = inside & np.isfinite(depth)
        clear[both] &= np.abs(z[both] - depth[both]) > rounding * z[both]
        closer = inside & (z < depth)
        ids[closer] = t
        depth[closer] = z[closer]
        for i in range(3):
            weights[closer, i] = (e[i] / corner[i, 2] / np.where(inside, inverse, 1.0))[closer]
    return ids, weights, depth, clear


def scene(seed, count=60):
    """Big, tiny, sliver, degenerate, off-screen, straddling and interpenetrating triangles."""
    rng = np.random.default_rng(seed)
    size = np.array([WIDTH, HEIGHT])
    centre = rng.uniform(-0.3, 1.3, (count, 1, 2)) * size
    radius = np.exp(rng.uniform(np.log(0.1), np.log(80.0), (count, 1, 1)))
    xy = centre + radius * rng.normal(size=(count, 3, 2))
    z = rng.uniform(300.0, 900.0, (count, 1)) + radius[:, :, 0] * rng.normal(size=(count, 3))
    corner = np.concatenate([xy, z[..., None]], axis=-1)
    corner[0, 1] = corner[0, 0]  # two corners equal
    corner[1, :] = corner[1, 0]  # a point
    corner[2, 2] = 0.5 * (corner[2, 0] + corner[2, 1])  # three in a line
    corner[3, 0, 2] = -5.0  # behind the camera
    corner[4, 1, 2] = 0.0
    corner[5, :, :2] = [[-1e4, -9e3], [1.3e4, -8e3], [20.0, 2e4]]  # covers the whole image
    corner[5, :, 2] = 1200.0
    corner[6, :, :2] = [[-3e3, 20.0], [3e3, 20.3], [3e3, 20.9]]  # a sliver across it
    corner[7, 0, 0] = np.nan
    corner[8, :, 0] += 3 * WIDTH
    faces = np.arange(3 * count).reshape(count, 3)
    flip = rng.random(count) < 0.5
    faces[flip] = faces[flip][:, ::-1]
    order = rng.permutation(count)
    return corner.reshape(-1, 3), faces[order]


@pytest.mark.parametrize("cull", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_equals_brute_force_in_double_precision(seed, cull):
    screen, faces = scene(seed)
    ids, weights, depth, _ = brute_force(screen, faces, HEIGHT, WIDTH, cull)
    with jax.enable_x64(True):
        got = rasterize(jnp.asarray(screen), jnp.asarray(faces), HEIGHT, WIDTH, cull=cull)
        assert got.depth.dtype == jnp.float64
        np.testing.assert_array_equal(got.triangle, ids)
        np.testing.assert_allclose(got.barycentric, weights, atol=1e-9)
        np.testing.assert_allclose(got.depth, depth, rtol=1e-9)
    assert len(np.unique(ids)) > 5


@pytest.mark.parametrize("seed", range(4, 8))
def test_equals_brute_force_in_single_precision_away_from_ties(seed):
    screen, faces = scene(seed)
    screen = screen.astype(np.float32)
    ids, weights, depth, clear = brute_force(screen, faces, HEIGHT, WIDTH)
    got = rasterize(jnp.asarray(screen), jnp.asarray(faces), HEIGHT, WIDTH)
    assert clear.mean() > 0.97
    np.testing.assert_array_equal(np.asarray(got.triangle)[clear], ids[clear])
    np.testing.assert_allclose(np.asarray(got.depth)[clear], depth[clear], rtol=1e-3)


@pytest.mark.parametrize("batch", [86, 100])  # 99 tiles cover the image
def test_batches_smaller_than_a_triangle_change_nothing(batch, monkeypatch):
    screen, faces = (jnp.asarray(a) for a in scene(11))
    screen = jnp.asarray(screen, jnp.float32)
    monkeypatch.setattr(zbuffer, "BATCH", batch)
    draw = inspect.unwrap(zbuffer.nearest_triangles)  # not what is compiled already
    parts = jax.jit(lambda s: draw(s[None], faces[None], HEIGHT, WIDTH, False, 0.0))(screen)
    whole = rasterize(screen, faces, HEIGHT, WIDTH)
    np.testing.assert_array_equal(parts[0], whole.triangle)


TILE = 6, 5  # columns and rows of the tiles that the next test looks through


@jax.jit
def cover_counts(x, y, faces):
    """How many triangles own each pixel centre of 10 rows by 12 columns, by the coverage test."""
    x, y = (tuple(v[faces[:, i]] for i in range(3)) for v in (x, y))
    zero = jnp.zeros(len(faces), jnp.int32)
    full = jnp.where(faces[:, 0] != faces[:, 1], 99, zero)  # a point has an empty block

    def tile(row, column):
        left, top = zero + column * TILE[0], zero + row * TILE[1]
        bits = tile_bits(x, y, left, top, full, full, zero + TILE[0], cull=False)
        owned = (bits[:, None] >> jnp.arange(TILE_PIXELS)) & 1
        return owned.sum(axis=0).reshape(TILE[::-1])

    return jnp.block([[tile(0, 0), tile(0, 1)], [tile(1, 0), tile(1, 1)]])


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**31 - 1),
    lattice=st.sampled_from([0.5, 0.25, 0.1, 1e-3, 0.0]),
    mirror=st.booleans(),
)
def test_every_centre_inside_a_mesh_has_exactly_one_owner(seed, lattice, mirror):
    rng = np.random.default_rng(seed)
    n = 9
    grid_x, grid_y = np.meshgrid(np.linspace(-1, 13, n), np.linspace(-1, 11, n))
    jitter = rng.uniform(-0.6, 0.6, (2, n, n))
    jitter[:, [0, -1]] = 0
    jitter[:, :, [0, -1]] = 0
    x, y = grid_x + jitter[0], grid_y + jitter[1]
    if lattice:
        # A lattice through the pixel centres puts centres on edges and on vertices.
        x, y = np.round(x / lattice) * lattice, np.round(y / lattice) * lattice
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    slash = rng.random(a.shape) < 0.5
    one = np.where(slash[..., None], np.stack([a, b, c], -1), np.stack([a, b, d], -1))
    two = np.where(slash[..., None], np.stack([b, d, c], -1), np.stack([a, d, c], -1))
    faces = np.concatenate([one.reshape(-1, 3), two.reshape(-1, 3)])
    faces = faces[:, ::-1] if mirror else faces
    x, y = (jnp.asarray(v.reshape(-1), jnp.float32) for v in (x, y))
    px, py = np.asarray(x, np.float64)[faces], np.asarray(y, np.float64)[faces]
    area = (px[:, 1] - px[:, 0]) * (py[:, 2] - py[:, 0]) - (py[:, 1] - py[:, 0]) * (
        px[:, 2] - px[:, 0]
    )
    # Jitter may fold a cell over itself: what is covered by turned triangles is taken away.
    turned = (area < 0) != mirror
    nothing = np.zeros_like(faces)
    proper = np.where((~turned & (area != 0))[:, None], faces, nothing)
    folded = np.where((turned & (area != 0))[:, None], faces, nothing)
    counts = np.asarray(cover_counts(x, y, proper) - cover_counts(x, y, folded))
    assert (counts == 1).all()


@settings(max_examples=50, deadline=None)
@given(columns=st.integers(0, 5000), rows=st.integers(0, 5000))
def test_tiles_hold_their_pixels_and_small_blocks_are_one_tile(columns, rows):
    wide, high = (int(n) for n in tile_shape(jnp.int32(columns), jnp.int32(rows)))
    assert wide >= 1 and high >= 1 and wide * high <= TILE_PIXELS
    if 0 < columns * rows <= TILE_PIXELS and columns <= 10:
        assert columns <= wide and rows <= high


def test_equal_depths_go_to_the_lowest_index():
    screen, faces = scene(3)
    faces = np.concatenate([faces, faces])
    got = rasterize(jnp.asarray(screen, jnp.float32), jnp.asarray(faces), HEIGHT, WIDTH)
    assert int(got.triangle.max()) < len(faces) // 2


def padded(screen, faces, count=60):
    """The same scene in the shapes of the others, so that it is not compiled again."""
    screen = np.pad(np.asarray(screen, np.float32), ((0, 3 * count - len(screen)), (0, 0)))
    faces = np.pad(np.asarray(faces), ((0, count - len(faces)), (0, 0)))
    return jnp.asarray(screen), jnp.asarray(faces)


def test_dropped_triangles():
    square = [[-5.0, -5, 400], [90, -5, 400], [-5, 90, 400], [90, 90, 50]]
    square, faces = padded(square, [[0, 2, 1], [1, 2, 3]])
    whole = rasterize(square, faces, HEIGHT, WIDTH)
    assert bool(whole.mask.all())
    near = rasterize(square, faces, HEIGHT, WIDTH, near=50.0)
    assert not bool((near.triangle == 1).any())
    behind = rasterize(square.at[3, 2].set(-1.0), faces, HEIGHT, WIDTH)
    np.testing.assert_array_equal(behind.triangle, near.triangle)
    assert bool(jnp.isinf(near.depth[~near.mask]).all())
    assert float(jnp.abs(near.barycentric[~near.mask]).max()) == 0
    front = rasterize(square, faces, HEIGHT, WIDTH, cull=True)
    back = rasterize(square, faces[:, ::-1], HEIGHT, WIDTH, cull=True)
    assert bool(front.mask.all()) and not bool(back.mask.any())


def test_culling_keeps_what_faces_the_camera():
    # Counter-clockwise seen from +z, before a camera that looks along -z.
    triangle = jnp.array([[-50.0, -50, -400], [50, -50, -400], [0, 50, -400]])
    camera = Camera.from_field_of_view(30.0, HEIGHT, WIDTH)
    screen, faces = padded(camera.project(triangle), [[0, 1, 2]])
    assert bool(rasterize(screen, faces, HEIGHT, WIDTH, cull=True).mask.any())
    assert not bool(rasterize(screen, faces[:, ::-1], HEIGHT, WIDTH, cull=True).mask.any())


def test_empty_meshes_and_wrong_arguments():
    screen, faces = jnp.zeros((4, 3)), jnp.zeros((0, 3), jnp.int32)
    got = rasterize(screen, faces, HEIGHT, WIDTH)
    assert not bool(got.mask.any()) and bool(jnp.isinf(got.depth).all())
    with pytest.raises(ValueError, match="height and width"):
        rasterize(screen, faces, 0, WIDTH)
    with pytest.raises(ValueError, match="screen has shape"):
        rasterize(screen[:, :2], faces, HEIGHT, WIDTH)
    with pytest.raises(ValueError, match="faces has shape"):
        rasterize(screen, faces[:, :2], HEIGHT, WIDTH)


def test_block_of_pixels_survives_coordinates_beyond_integers():
    x, y = [jnp.array([v, 3.0]) for v in (-1e30, 4.2, 1e30)], [jnp.array([v]) for v in (0.0, 9, 1)]
    left, top, columns, rows = pixel_block(tuple(x), tuple(y), jnp.array([True]), 20, 30)
    assert (int(left[0]), int(columns[0]), int(top[0]), int(rows[0])) == (0, 30, 0, 9)


def test_vmap_equals_a_loop():
    scenes = [scene(seed) for seed in (20, 21, 22)]
    screens = jnp.stack([jnp.asarray(s, jnp.float32) for s, _ in scenes])
    faces = jnp.stack([jnp.asarray(f) for _, f in scenes])

    def draw(screen, faces):
        return rasterize(screen, faces, HEIGHT, WIDTH)

    def check(got, pick_screen, pick_faces):
        for i in range(3):
            alone = draw(pick_screen(i), pick_faces(i))
            np.testing.assert_array_equal(got.triangle[i], alone.triangle)
            np.testing.assert_allclose(got.depth[i], alone.depth, rtol=1e-5)

    check(jax.vmap(draw)(screens, faces), lambda i: screens[i], lambda i: faces[i])
    shared = jax.jit(jax.vmap(draw, in_axes=(0, None)))(screens, faces[0])
    check(shared, lambda i: screens[i], lambda i: faces[0])
    nested = jax.vmap(jax.vmap(draw, in_axes=(None, 0)), in_axes=(0, None))(screens, faces)
    assert nested.triangle.shape == (3, 3, HEIGHT, WIDTH)
    np.testing.assert_array_equal(nested.triangle[1, 2], draw(screens[1], faces[2]).triangle)


def test_weights_interpolate_in_perspective():
    camera = Camera.from_field_of_view(60.0, HEIGHT, WIDTH)
    points = jnp.array([[-90.0, -80, -150], [110, -70, -420], [0, 120, -900]])
    faces = jnp.array([[0, 1, 2]])
    fragments = rasterize(*padded(camera.project(points), faces), HEIGHT, WIDTH)
    assert int(fragments.mask.sum()) > 200
    # The interpolated point must project to the centre of the pixel that shows it.
    seen = interpolate(points, faces, fragments)[fragments.mask]
    y, x = jnp.nonzero(fragments.mask)
    projected = camera.project(seen)
    np.testing.assert_allclose(projected[:, 0], x + 0.5, atol=1e-3)
    np.testing.assert_allclose(projected[:, 1], y + 0.5, atol=1e-3)
    np.testing.assert_allclose(projected[:, 2], fragments.depth[fragments.mask], rtol=1e-5)
    np.testing.assert_allclose(fragments.barycentric.sum(-1)[fragments.mask], 1.0, atol=1e-6)


def test_derivative_of_depth_equals_differences():
    with jax.enable_x64(True):
        screen, faces = (jnp.asarray(a) for a in scene(5))
        screen = jnp.where(jnp.isfinite(screen), screen, 0.0)
        step = jnp.asarray(np.random.default_rng(3).normal(size=screen.shape))
        h = 1e-6
        draw = jax.jit(lambda s: rasterize(s, faces, HEIGHT, WIDTH))
        ahead, behind = draw(screen + h * step), draw(screen - h * step)
        here, tangent = jax.jvp(lambda s: draw(s).depth, (screen,), (step,))
        fixed = (ahead.triangle == behind.triangle) & jnp.isfinite(here)
        difference = (ahead.depth - behind.depth) / (2 * h)
        np.testing.assert_allclose(tangent[fixed], difference[fixed], rtol=1e-4, atol=1e-3)


def test_no_nan_at_degenerate_triangles():
    screen, faces = scene(6)
    screen = jnp.asarray(np.where(np.isfinite(screen), screen, 0.0), jnp.float32)
    # Also ask for triangles that do not cover their pixel, or cover none at all.
    everywhere = jnp.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) % len(faces)
    everywhere = everywhere.at[0].set(-1)
    weights, tangent = jax.jvp(
        lambda s: barycentrics(s, jnp.asarray(faces), everywhere), (screen,), (screen,)
    )
    gradient = jax.grad(lambda s: barycentrics(s, jnp.asarray(faces), everywhere)[..., 0].sum())
    drawn = jax.grad(
        lambda s: jnp.sum(rasterize(s, jnp.asarray(faces), HEIGHT, WIDTH).barycentric[..., 1])
    )
    for array in (weights, tangent, gradient(screen), drawn(screen)):
        assert bool(jnp.isfinite(array).all())
    assert float(jnp.abs(weights[0]).max()) == 0
