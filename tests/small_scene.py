"""A small morphable model and photo, in double precision, for gradients."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxface.models.linear import LinearBasis
from jaxface.models.morphable import MorphableModel, SurfacePoints
from jaxface.models.parameters import FaceParameters, neutral_parameters


def grid_faces(side: int) -> np.ndarray:
    """Triangles of a grid, counter-clockwise seen from +z."""
    index = np.arange(side * side).reshape(side, side)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    return faces.reshape(-1, 3)


def small_model(side: int = 16, seed: int = 0) -> MorphableModel:
    """A bump of ``side`` x ``side`` vertices with smooth random modes."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(-80, 80, side), np.linspace(80, -80, side))
    mean = np.stack([x, y, 45 * np.exp(-(x**2 + y**2) / 3500)], axis=-1).reshape(-1, 3)
    faces = grid_faces(side)

    def smooth_modes(count: int, scale: float) -> LinearBasis:
        waves = rng.normal(size=(count, 3, 2)) / 40
        phase = rng.uniform(0, 6, size=(count, 3))
        values = np.sin(np.einsum("kcd,nd->nck", waves, mean[:, :2]) + phase.T)
        return LinearBasis(jnp.asarray(values * scale), jnp.ones(count))

    landmarks = rng.choice(len(faces), 12, replace=False)
    weights = rng.dirichlet(np.ones(3), 12)
    points = SurfacePoints(jnp.asarray(faces[landmarks]), jnp.asarray(weights))
    return MorphableModel(
        mean=jnp.asarray(mean),
        identity=smooth_modes(5, 3.0),
        expression=smooth_modes(3, 2.0),
        albedo_mean=jnp.asarray(0.5 + 0.2 * np.sin(mean / 20)),
        albedo=smooth_modes(4, 0.05),
        faces=jnp.asarray(faces, jnp.int32),
        uv=jnp.asarray(mean[:, :2] / 200 + 0.5),
        uv_faces=jnp.asarray(faces, jnp.int32),
        landmarks68=points,
        landmarks468=None,
        region=jnp.zeros(len(mean), jnp.int32),
        name="bump",
        region_names=("face",),
        expression_names=("a", "b", "c"),
        licence="none",
    )


def small_parameters(model: MorphableModel, seed: int = 1, spread: float = 0.1) -> FaceParameters:
    """Parameters near the neutral ones, light from above left."""
    rng = np.random.default_rng(seed)
    y = neutral_parameters(model)
    noisy = jax.tree.map(lambda a: a + spread * jnp.asarray(rng.normal(size=a.shape)), y)
    light = jnp.zeros((9, 3)).at[0].set(3.0).at[1].set(0.8).at[3].set(-0.5)
    return FaceParameters(
        noisy.identity, noisy.expression, noisy.albedo, light + 0.1 * noisy.light,
        noisy.rotation, y.translation + jnp.array([3.0, -2.0, 10.0]), y.log_focal + 0.05,
    )  # fmt: skip


def small_samples(model: MorphableModel, y: FaceParameters, size: int = 40, seed: int = 2):
    """Visible pixels of a random photo at ``y``, fewer than there is room for."""
    from jaxface.render._rasterize import rasterize
    from jaxface.stages.fit.samples import sample_pixels

    principal = jnp.array([0.48, 0.53])
    screen = y.camera(principal, size).project(y.pose(model.shape(y.identity, y.expression)))
    triangle = rasterize(screen, model.faces, size, size).triangle
    image = jnp.asarray(np.random.default_rng(seed).uniform(0, 1, (size, size, 3)))
    every = jnp.ones(model.faces.shape[0], bool)
    mask = jnp.ones((size, size)).at[:, :3].set(0.4)
    return sample_pixels(image, mask, triangle, model.faces, every, principal, size * size)
