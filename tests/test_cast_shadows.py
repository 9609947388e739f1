"""Hard shadows of a fit: a board that casts one on the ground, under a lamp of known place."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxface.geometry.mesh import vertex_normals
from jaxface.geometry.normal_stencil import normal_stencil
from jaxface.models.linear import LinearBasis
from jaxface.models.morphable import MorphableModel, SurfacePoints
from jaxface.models.parameters import FaceParameters
from jaxface.render._interpolate import interpolate
from jaxface.render._rasterize import rasterize
from jaxface.render.occlusion import (
    hidden_directions,
    hidden_shading,
    self_occlusion,
    sphere_lattice,
)
from jaxface.render.shading import irradiance
from jaxface.stages.fit._cast_shadows import cast_shadows, shadow_trust
from jaxface.stages.fit.prepared import FitModel
from jaxface.stages.fit.records import FitInput
from jaxface.stages.fit.samples import sample_pixels
from tests.small_scene import grid_faces

SIZE = 96
SIDE = 33
LAMP = np.array([0.8, 0.1, 0.6]) / np.linalg.norm([0.8, 0.1, 0.6])
ALBEDO = 0.5
AMBIENT, KEY = 0.3, 1.2  # shading by even light, and by the lamp at right angles


def scene() -> MorphableModel:
    """Ground of 160 mm with a board of 40 mm upright on it; nothing to fit but the light."""
    x, y = np.meshgrid(np.linspace(-80, 80, SIDE), np.linspace(80, -80, SIDE))
    ground = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    board = np.array([[10, -60, 0], [10, 60, 0], [10, 60, 40], [10, -60, 40]], float)
    sheet = np.array([[0, 1, 2], [0, 2, 3], [2, 1, 0], [3, 2, 0]]) + len(ground)
    vertices = np.concatenate([ground, board])
    faces = np.concatenate([grid_faces(SIDE), sheet])
    none = LinearBasis(jnp.zeros((len(vertices), 3, 0)), jnp.zeros(0))
    points = SurfacePoints(jnp.asarray(faces[:12]), jnp.full((12, 3), 1 / 3))
    model = MorphableModel(
        mean=jnp.asarray(vertices, jnp.float32), identity=none, expression=none,
        albedo_mean=jnp.full((len(vertices), 3), ALBEDO), albedo=none,
        faces=jnp.asarray(faces, jnp.int32), uv=jnp.zeros((len(vertices), 2)),
        uv_faces=jnp.asarray(faces, jnp.int32), landmarks68=points, landmarks468=None,
        region=jnp.zeros(len(vertices), jnp.int32), name="board", region_names=("face",),
        expression_names=(), licence="none",
    )  # fmt: skip
    shadow = self_occlusion(model.mean, model.faces, directions=96, size=96)
    return dataclasses.replace(model, occlusion=shadow)


def true_shading(points: np.ndarray) -> np.ndarray:
    """Of the ground, nothing but the lamp being hidden."""
    reach = (10 - points[:, 0]) / LAMP[0]
    height, along = reach * LAMP[2], points[:, 1] + reach * LAMP[1]
    hidden = (reach > 0) & (height < 40) & (np.abs(along) < 60)
    return AMBIENT + KEY * LAMP[2] * ~hidden


cast_program = jax.jit(cast_shadows)


@pytest.fixture(scope="module")
def photo():
    model = scene()
    light = jnp.zeros((9, 3)).at[0].set(3.0)
    y = FaceParameters(
        jnp.zeros(0), jnp.zeros(0), jnp.zeros(0), light, jnp.zeros(3),
        jnp.array([0.0, 0.0, -600.0]), jnp.asarray(np.log(3.0), jnp.float32),
    )  # fmt: skip
    prepared = FitModel(
        model, normal_stencil(np.asarray(model.faces), model.vertex_count), model.landmarks68,
        jnp.zeros(0, jnp.int32), jnp.arange(4, dtype=jnp.int32),
        jnp.arange(model.vertex_count) < SIDE**2,
        jnp.arange(len(model.faces)) < 2 * (SIDE - 1) ** 2,
    )  # fmt: skip
    principal = jnp.array([0.5, 0.5])
    screen = y.camera(principal, SIZE).project(y.pose(model.mean))
    fragments = rasterize(screen, model.faces, SIZE, SIZE)
    place = np.asarray(interpolate(model.mean, model.faces, fragments)).reshape(-1, 3)
    image = (ALBEDO * true_shading(place)).reshape(SIZE, SIZE, 1) * np.ones(3)
    data = FitInput(
        jnp.asarray(image, jnp.float32), jnp.ones((SIZE, SIZE)), jnp.zeros((12, 2)), jnp.ones(12),
        jnp.asarray(0.3), principal, y.log_focal, jnp.asarray(0.1), jnp.asarray(False),
    )  # fmt: skip
    found, *cast = cast_program(y, data.image, data.mask, data, prepared, model)
    return model, y, prepared, data, found, cast, fragments


def shading_at_ground(model, transfer, y):
    normals = vertex_normals(model.mean, model.faces)
    shading = irradiance(normals, y.light) + hidden_shading(transfer, jnp.eye(3), y.light)
    return np.asarray(shading)[: SIDE**2]


def test_the_shadow_lies_where_the_lamp_casts_it(photo):
    model, y, _, _, found, (transfer, _), _ = photo
    ground = np.asarray(model.mean)[: SIDE**2]
    truth = true_shading(ground)
    shading = shading_at_ground(model, transfer, found).mean(axis=1)
    # Pixels of the rim and the board's foot aside; edges are as soft as the lattice is coarse.
    inner = (np.abs(ground) < 65).all(axis=1) & (np.abs(ground[:, 0] - 10) > 6)
    error = np.abs(shading - truth)[inner]
    assert np.mean(error) < 0.1 < 0.4 * np.std(truth[inner])
    assert np.median(error) < 0.04
    dark = inner & (truth < 0.5) & (ground[:, 0] > -15) & (np.abs(ground[:, 1]) < 40)
    np.testing.assert_allclose(shading[dark].mean(), AMBIENT, atol=0.1)


def test_nine_harmonics_alone_do_not_hold_it(photo):
    model, y, _, _, found, (transfer, _), _ = photo
    truth = true_shading(np.asarray(model.mean)[: SIDE**2])
    hard = np.abs(shading_at_ground(model, transfer, found).mean(axis=1) - truth).mean()
    soft = np.abs(shading_at_ground(model, model.occlusion, found).mean(axis=1) - truth).mean()
    assert hard < 0.6 * soft


def test_ground_in_shadow_does_not_get_brighter_by_turning_to_the_lamp(photo):
    model, y, _, _, found, (transfer, slope), _ = photo
    shadowed = dataclasses.replace(model, occlusion=transfer, occlusion_slope=slope)
    normals = vertex_normals(model.mean, model.faces)
    # At the normals of the shape itself the slope adds nothing.
    np.testing.assert_allclose(shadowed.occlusion_of(normals), transfer, atol=1e-5)
    towards = normals + 0.2 * jnp.asarray(LAMP - LAMP[2] * np.array([0, 0, 1.0]), jnp.float32)
    towards = towards / jnp.linalg.norm(towards, axis=1, keepdims=True)

    def shading(model):
        hidden = hidden_shading(model.occlusion_of(towards), jnp.eye(3), found.light)
        return np.asarray(irradiance(towards, found.light) + hidden).mean(axis=1)

    change = shading(shadowed) - shading(dataclasses.replace(shadowed, occlusion_slope=None))
    place = np.asarray(model.mean)
    ground = (np.abs(place) < 60).all(axis=1) & (np.arange(len(place)) < SIDE**2)
    deep = ground & (np.abs(place[:, 0] + 15) < 8) & (np.abs(place[:, 1]) < 35)
    turn = np.asarray(towards - normals)[deep].mean(axis=0)
    # What the lamp would have added is taken away again, and what of the even light comes from
    # where the board is, seen from the middle of these places.
    sky = sphere_lattice(4096)
    with np.errstate(divide="ignore"):
        reach = (10 + 15) / sky[:, 0]
    behind = (reach > 0) & (sky[:, 2] > 0) & (reach * sky[:, 2] < 40)
    behind &= np.abs(reach * sky[:, 1]) < 60
    gained = KEY * turn @ LAMP + AMBIENT * 4 / len(sky) * np.sum(sky[behind] @ turn)
    assert np.mean(change[deep]) == pytest.approx(-gained, rel=0.1)
    assert np.mean(np.abs(change[ground & (place[:, 0] > 30)])) < 0.15 * gained


def test_pixels_in_shadow_are_trusted_less(photo):
    model, _, prepared, data, found, (transfer, _), fragments = photo
    shadowed = dataclasses.replace(model, occlusion=transfer)
    samples = sample_pixels(
        data.image, data.mask, fragments.triangle, model.faces, prepared.face_mask,
        data.principal, SIZE * SIZE,
    )  # fmt: skip
    trust = np.asarray(shadow_trust(found, shadowed, samples))
    used = np.asarray(samples.weight) > 0
    colour = np.asarray(samples.color)[:, 0]
    assert trust.min() >= 0 and trust.max() <= 1
    assert trust[used & (colour < 0.2)].mean() < 0.2
    assert trust[used & (colour > 0.4)].mean() > 0.8
    bare = dataclasses.replace(model, occlusion=None)
    np.testing.assert_array_equal(shadow_trust(found, bare, samples), 1.0)


def test_no_gradient_passes(photo):
    """Neither from the fit so far, nor from the photo, nor from the model."""
    model, y, prepared, data, *_ = photo

    def total(y, image, data, prepared):
        found = cast_shadows(
            y, image, data.mask, data, prepared, model, directions=32, pixels=200, rounds=2
        )
        return sum(jnp.sum(jnp.sin(x)) for x in jax.tree.leaves(found))

    given = (y, data.image, data, prepared)
    slope = eqx.filter_jit(eqx.filter_grad(lambda given: total(*given)))(given)
    leaves = jax.tree.leaves(slope)
    assert len(leaves) > 15
    for leaf in leaves:
        np.testing.assert_array_equal(leaf, 0.0)


def test_nothing_is_nan_in_the_dark(photo):
    model, y, prepared, data, *_ = photo
    black = jnp.zeros_like(data.image)
    dark = cast_program(y, black, data.mask, data, prepared, model)
    assert all(np.isfinite(np.asarray(x)).all() for x in jax.tree.leaves(dark))
    nothing = cast_program(y, data.image, 0 * data.mask, data, prepared, model)
    assert all(np.isfinite(np.asarray(x)).all() for x in jax.tree.leaves(nothing))


def test_a_model_without_self_occlusion_is_refused(photo):
    model, y, prepared, data, *_ = photo
    bare = dataclasses.replace(prepared, model=dataclasses.replace(model, occlusion=None))
    with pytest.raises(ValueError, match="no occlusion"):
        cast_shadows(y, data.image, data.mask, data, bare, model)


def test_hidden_directions_against_rays():
    model = scene()
    rng = np.random.default_rng(0)
    points = np.stack([rng.uniform(-60, 60, 200), rng.uniform(-60, 60, 200), np.zeros(200)], axis=1)
    normals = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    found = np.asarray(hidden_directions(
        jnp.asarray(points), jnp.asarray(normals), model.mean, model.faces, sphere_lattice(128),
        size=256,
    ))  # fmt: skip
    lattice = sphere_lattice(128)
    start = points + 2.0 * normals
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (10 - start[:, None, 0]) / lattice[None, :, 0]
        hit = start[:, None] + reach[..., None] * lattice[None]
    expected = (reach > 0) & (hit[..., 2] < 40) & (hit[..., 2] > 0) & (np.abs(hit[..., 1]) < 60)
    asked = lattice[:, 2] > 0.1
    wrong = (found != expected)[:, asked]
    assert wrong.mean() < 0.02
