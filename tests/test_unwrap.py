"""Unwrapping a rendered photo gives the texture back, where and only where the photo shows it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxface.geometry.camera import Camera
from jaxface.geometry.mesh import vertex_normals
from jaxface.geometry.uv import UVLayout, uv_layout
from jaxface.render._interpolate import interpolate
from jaxface.render._rasterize import rasterize
from jaxface.render.shading import irradiance
from jaxface.stages._unwrap import unwrap
from jaxface.stages.texture.low_frequency import low_frequency_albedo, over_low_frequency

SIZE = 200  # px of the photo
TEXELS = 160


class Scene(NamedTuple):
    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    uv_faces: np.ndarray
    camera: Camera
    light: jax.Array
    layout: UVLayout
    photo: jax.Array
    mask: jax.Array
    truth: np.ndarray


def texture(uv):
    """A smooth procedural albedo, different at every texel (linear RGB)."""
    u, v = uv[..., 0], uv[..., 1]
    waves = [0.5 + 0.25 * jnp.sin(a * u + b * v + p) for a, b, p in [(31, 9, 0), (7, -25, 1)]]
    return jnp.stack([*waves, 0.3 + 0.3 * u], axis=-1)


def ellipsoid(rows=24, columns=40):
    """An egg (mm) with latitude-longitude UVs in the upper half of the texture, cut at the back."""
    theta = np.linspace(0.02, np.pi - 0.02, rows + 1)
    phi = np.linspace(0, 2 * np.pi, columns + 1)
    t, p = np.meshgrid(theta, phi, indexing="ij")
    corner = np.stack([-np.sin(t) * np.sin(p), np.cos(t), -np.sin(t) * np.cos(p)], -1)
    uv = np.stack([0.05 + 0.9 * p / (2 * np.pi), 0.97 - 0.55 * t / np.pi], -1).reshape(-1, 2)
    index = np.arange(len(uv)).reshape(rows + 1, columns + 1)
    closed = index.copy()
    closed[:, -1] = closed[:, 0]

    def triangles(i):
        a, b, c, d = i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]
        return np.concatenate([np.stack(x, -1).reshape(-1, 3) for x in ((a, b, c), (a, c, d))])

    return corner.reshape(-1, 3) * [70, 100, 80], triangles(closed), uv, triangles(index)


def build() -> Scene:
    """The egg with a square card before it (its own chart below), partly out of the picture."""
    vertices, faces, uv, uv_faces = ellipsoid()
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    outward = np.sum(np.cross(b - a, c - a) * (a + b + c))
    assert outward > 0
    card = np.array([[-5, -60, 110], [45, -60, 110], [45, 10, 110], [-5, 10, 110.0]])
    card_uv = np.array([[0.1, 0.05], [0.35, 0.05], [0.35, 0.35], [0.1, 0.35]])
    quad = np.array([[0, 1, 2], [0, 2, 3]])
    faces = np.concatenate([faces, quad + len(vertices)])
    uv_faces = np.concatenate([uv_faces, quad + len(uv)])
    vertices = np.concatenate([vertices, card]) + [60.0, 10, -520]
    uv = np.concatenate([uv, card_uv])
    camera = Camera(jnp.float32(430), jnp.array([SIZE / 2, SIZE / 2], jnp.float32))
    light = jnp.zeros((9, 3)).at[0].set(jnp.array([2.4, 2.2, 2.0])).at[1].set(0.3)
    light = light.at[2].set(0.4).at[3].set(jnp.array([0.5, 0.4, 0.2])).at[7].set(0.1)
    points = jnp.asarray(vertices, jnp.float32)
    fragments = rasterize(camera.project(points), jnp.asarray(faces), SIZE, SIZE)
    at = interpolate(jnp.asarray(uv, jnp.float32), jnp.asarray(uv_faces), fragments)
    normal = interpolate(vertex_normals(points, jnp.asarray(faces)), jnp.asarray(faces), fragments)
    normal = normal / jnp.maximum(jnp.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    # The background is far brighter than any skin: a texel that touches it shows.
    photo = jnp.where(fragments.mask[..., None], texture(at) * irradiance(normal, light), 9.0)
    layout = uv_layout(uv, uv_faces, TEXELS, gutter=3)
    line = (np.arange(TEXELS) + 0.5) / TEXELS
    truth = np.asarray(texture(np.stack(np.meshgrid(line, 1 - line), -1)))
    return Scene(points, faces, uv, uv_faces, camera, light, layout, photo, fragments.mask, truth)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return build()


def run(scene: Scene, **options):
    s = scene._replace(**{k: options.pop(k) for k in list(options) if k in Scene._fields})
    return unwrap(
        s.photo, s.mask, s.vertices, jnp.asarray(s.faces), s.camera, s.light, s.layout, **options
    )


def psnr(result, scene, threshold):
    chosen = (np.asarray(result.weight) > threshold) & np.asarray(scene.layout.inside)
    error = np.asarray(result.albedo)[chosen] - scene.truth[chosen]
    return -10 * np.log10(np.mean(error**2)), chosen.mean()


def geometry(scene: Scene):
    """Camera-frame point and face normal of every texel, in double precision."""
    triangle = np.asarray(scene.layout.triangle)
    weights = np.asarray(scene.layout.barycentric, np.float64)
    weights = np.concatenate([1 - weights.sum(-1, keepdims=True), weights], -1)
    corner = np.asarray(scene.vertices, np.float64)[np.asarray(scene.faces)]
    point = np.einsum("hwi,hwic->hwc", weights, corner[triangle])
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    return point, normal[triangle]


def blocked(origin: np.ndarray, scene: Scene) -> np.ndarray:
    """Brute force: whether any triangle crosses the line from a point to the camera."""
    a, b, c = (np.asarray(scene.vertices, np.float64)[scene.faces[:, i]] for i in range(3))
    hit = np.zeros(len(origin), bool)
    for start in range(0, len(origin), 500):
        o = origin[start : start + 500, None]
        # Moeller and Trumbore 1997, with the ray o - t o, 0 < t < 1.
        p = np.cross(-o, c - a)
        inverse = 1 / np.sum((b - a) * p, -1)
        s = o - a
        u = np.sum(s * p, -1) * inverse
        q = np.cross(s, b - a)
        v = np.sum(-o * q, -1) * inverse
        t = np.sum((c - a) * q, -1) * inverse
        inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 2e-3) & (t < 1)
        hit[start : start + 500] = inside.any(-1)
    return hit


def test_the_texture_comes_back(scene):
    result = run(scene)
    quality, share = psnr(result, scene, 0.01)
    assert quality > 36 and share > 0.08
    best, _ = psnr(result, scene, 0.95)
    assert best > 38
    assert np.isfinite(result.albedo).all() and float(result.albedo.max()) < 1.5
    assert ((result.weight >= 0) & (result.weight <= 1)).all()
    assert not (np.asarray(result.albedo)[np.asarray(result.weight) == 0]).any()


def test_visibility_agrees_with_brute_force_rays(scene):
    visible = np.asarray(run(scene).visible)
    inside = np.asarray(scene.layout.inside)
    point, normal = geometry(scene)
    facing = np.sum(normal * point, -1) < 0
    x = SIZE / 2 - 430 * point[..., 0] / point[..., 2]
    y = SIZE / 2 + 430 * point[..., 1] / point[..., 2]
    in_photo = (np.minimum(x, y) > 0) & (np.maximum(x, y) < SIZE)
    assert (inside & facing & ~in_photo).sum() > 50
    candidates = inside & facing & in_photo
    rays = np.zeros(inside.shape, bool)
    rays[candidates] = ~blocked(point[candidates], scene)
    hidden_by_card = candidates & ~rays
    assert hidden_by_card.sum() > 200
    left_out, let_in = rays & ~visible, visible & ~rays
    buffer = rasterize(scene.camera.project(scene.vertices), jnp.asarray(scene.faces), SIZE, SIZE)
    from scipy.ndimage import distance_transform_edt

    depth = np.where(np.isfinite(buffer.depth), buffer.depth, 9e3)
    smooth = np.ones_like(depth, bool)
    for axis in (0, 1):
        jump = np.abs(np.diff(depth, axis=axis)) > 8
        smooth &= ~np.insert(jump, 0, False, axis) & ~np.insert(jump, jump.shape[axis], False, axis)
    clearance = np.asarray(distance_transform_edt(np.pad(smooth, 1)))[1:-1, 1:-1]

    def to_contour(texels):
        return clearance[y[texels].astype(int), x[texels].astype(int)]

    # The two disagree only where a contour passes within a pixel or two, and the weight with it.
    assert left_out.sum() < 0.15 * rays.sum() and to_contour(left_out).max() <= 3
    assert let_in.sum() < 20 and (to_contour(let_in) <= 1).all()
    assert np.asarray(run(scene).weight)[let_in].max(initial=0) < 0.1


def test_mask_is_respected_and_nothing_bleeds_in(scene):
    half = scene.mask & (jnp.arange(SIZE) < 140)
    photo = jnp.where(half[..., None], scene.photo, 50.0)
    result = run(scene, mask=half, photo=photo)
    point, _ = geometry(scene)
    x = SIZE / 2 - 430 * point[..., 0] / point[..., 2]
    weight = np.asarray(result.weight)
    # The photo is read at mipmap levels up to 2 here, whose pixels reach 4 px beyond the edge.
    assert (weight[x > 144] == 0).all() and (weight[x > 141] < 0.1).all()
    assert (weight[x < 135] > 0.5).sum() > 200
    assert psnr(result, scene, 0.01)[0] > 36
    soft = run(scene, mask=0.5 * half)
    np.testing.assert_allclose(soft.weight, 0.5 * weight, atol=1e-3)
    nothing = run(scene, mask=jnp.zeros_like(scene.mask))
    assert not nothing.visible.any() and not nothing.weight.any()


def test_weight_falls_smoothly_with_the_angle_to_the_view(scene):
    wide = np.asarray(run(scene, grazing=(85.0, 20.0), feather_width=0.0).weight)
    rim = np.abs(np.diff(wide[20:60], axis=1))
    assert wide.max() > 0.99 and rim[:, :60].max() < 0.25
    narrow = np.asarray(run(scene, grazing=(40.0, 20.0), feather_width=0.0).weight)
    assert (narrow <= wide + 1e-6).all() and narrow.sum() < 0.8 * wide.sum()


def test_too_dark_to_divide_by(scene):
    # Light from the right alone: the left of the egg is unlit.
    light = jnp.zeros((9, 3)).at[0].set(0.4).at[3].set(1.2)
    normals = vertex_normals(scene.vertices, jnp.asarray(scene.faces))
    unlit = np.asarray(irradiance(normals, light))[:, :1] <= 0
    dark = np.asarray(scene.layout(unlit.astype(np.float32), jnp.asarray(scene.faces)))[..., 0] == 1
    result = run(scene, light=light)
    assert dark.sum() > 500 and (np.asarray(result.weight)[dark] == 0).all()
    assert np.isfinite(result.albedo).all() and (result.weight > 0.5).sum() > 200


def test_gutter_and_seam_continue_the_charts(scene):
    result = run(scene, feather_width=0.0)
    card = np.asarray(scene.layout.triangle) >= len(scene.faces) - 2
    band = card & ~np.asarray(scene.layout.inside)
    lit = band & (np.asarray(result.weight) > 0)
    # Part of the card is beyond the photo.
    assert band.sum() > 100 and lit.sum() > 0.5 * band.sum()
    assert np.asarray(result.albedo)[lit].min() > 0.2
    assert not np.asarray(result.visible)[band].any()


@pytest.mark.parametrize("tile", [57, 512])
def test_tiles_do_not_show(scene, tile):
    one, other = run(scene), run(scene, tile=tile)
    np.testing.assert_allclose(other.albedo, one.albedo, atol=2e-5)
    np.testing.assert_array_equal(other.visible, one.visible)


def test_a_coarse_depth_buffer_hides_the_same_texels(scene):
    fine, coarse = run(scene), run(scene, depth_size=90)
    agree = np.asarray(fine.visible) == np.asarray(coarse.visible)
    assert agree[np.asarray(scene.layout.inside)].mean() > 0.96
    assert psnr(coarse, scene, 0.01)[0] > 36


def test_a_dense_photo_is_filtered_to_the_texture(scene):
    # 1 px checks in the photo are finer than the texels of a small texture: they must average out.
    checks = 0.5 + 0.5 * ((jnp.arange(SIZE)[:, None] + jnp.arange(SIZE)) % 2)
    small = uv_layout(scene.uv, scene.uv_faces, 32, gutter=0)
    flat = jnp.zeros((9, 3)).at[0].set(1 / 0.282095)
    result = run(scene, layout=small, light=flat, photo=checks[..., None] * jnp.ones(3))
    sure = np.asarray(result.weight) > 0.9
    assert sure.sum() > 20
    assert np.asarray(result.albedo)[sure].std() < 0.05


def test_gradients_to_photo_and_light(scene, x64):
    s = scene
    layout = uv_layout(s.uv, s.uv_faces, 24, gutter=1)
    photo, light = s.photo.astype(jnp.float64), s.light.astype(jnp.float64)
    camera = Camera(jnp.float64(430), jnp.array([SIZE / 2, SIZE / 2], jnp.float64))
    vertices = jnp.asarray(s.vertices, jnp.float64)

    def total(photo, light):
        out = unwrap(photo, s.mask, vertices, jnp.asarray(s.faces), camera, light, layout)
        return jnp.sum(jnp.sin(3 * out.albedo) * out.weight[..., None])

    check_grads(jax.jit(total), (photo, light), order=1, modes=("fwd", "rev"), eps=1e-6, rtol=1e-4)


def test_preview_keeps_what_is_known_and_matches_colours_elsewhere(scene):
    result = run(scene)
    faces = jnp.asarray(scene.faces)
    # A low-frequency albedo of the right colours but half as bright.
    model = 0.5 * jnp.ones((len(scene.vertices), 3)) * jnp.array([0.5, 0.5, 0.45])
    low = low_frequency_albedo(result.albedo, result.weight, model, faces, scene.layout, cells=16)
    preview = np.asarray(over_low_frequency(result.albedo, result.weight, low))
    sure = np.asarray(result.weight) == 1
    np.testing.assert_allclose(preview[sure], np.asarray(result.albedo)[sure], atol=1e-6)
    unknown = (np.asarray(result.weight) == 0) & np.asarray(scene.layout.inside)
    np.testing.assert_allclose(preview[unknown].mean(0), [0.5, 0.5, 0.45], atol=0.12)
    empty = np.asarray(scene.layout.triangle) < 0
    np.testing.assert_allclose(preview[empty], np.tile([0.25, 0.25, 0.225], (empty.sum(), 1)), 1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"photo": jnp.zeros((8, 8))}, r"photo has shape \(8, 8\)"),
        ({"mask": jnp.zeros((8, 9))}, r"mask has shape \(8, 9\)"),
        ({"faces": np.zeros((5, 3), int)}, "but faces has 5"),
        ({"grazing": (40.0, 60.0)}, "grazing is"),
        ({"shading_floor": 0.0}, "shading_floor is 0"),
        ({"depth_size": 0}, "longest is 0"),
    ],
)
def test_errors_name_the_argument(scene, change, message):
    with pytest.raises(ValueError, match=message):
        run(scene, **change)
