"""A small photo whose fit takes next to nothing: a bump with 68 landmarks, seen from the front."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxface.models.morphable import MorphableModel, SurfacePoints
from jaxface.models.parameters import FaceParameters
from jaxface.render.image import render
from jaxface.stages.fit import prepare
from tests.small_scene import small_model, small_parameters

SIDE = 96
"""px along a side of the photo"""


def small_face() -> MorphableModel:
    """The bump of ``small_scene`` in single precision, with 68 points."""
    model = small_model(12)
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(model.faces), 68, replace=False)
    points = SurfacePoints(
        jnp.asarray(model.faces)[chosen].astype(jnp.int32), jnp.full((68, 3), 1 / 3, jnp.float32)
    )
    model = dataclasses.replace(model, landmarks68=points)
    return jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype.kind == "f" else x, model)


def small_photo(model: MorphableModel) -> tuple[np.ndarray, np.ndarray, FaceParameters]:
    """The photo (sRGB-encoded, grey about the bump), its landmarks (px), and what it shows."""
    y = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), small_parameters(model))
    shape, principal = model.shape(y.identity, y.expression), jnp.array([0.5, 0.5])
    camera = y.camera(principal, SIDE)
    picture = render(
        shape, model.reflectance(y.albedo), model.faces, y.pose, camera, y.light, SIDE, SIDE
    )
    shown = np.where(np.asarray(picture.mask)[..., None] > 0, np.asarray(picture.color), 0.2)
    encoded = np.clip(shown / (1.2 * shown.max()), 0, 1) ** (1 / 2.2)
    points = camera.project(y.pose(prepare(model, 68).points(shape)))[:, :2]
    return encoded.astype(np.float32), np.asarray(points), y
