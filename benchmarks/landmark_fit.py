"""The landmark-only start of the fit by itself: 68 points to shape and pose, compiled."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Float
from jaxface.models.morphable import MorphableModel
from jaxface.stages.fit import FitConfig, FitInput, FitModel, FitWeights, prepare
from jaxface.stages.fit.start import fit_landmarks


def _landmarks_to_shape(
    points: Float[Array, "68 2"], model: FitModel, weights: FitWeights, config: FitConfig
) -> tuple[Float[Array, "n 3"], Float[Array, "68 2"]]:
    """Vertices (mm) and where the 68 points come to lie, both for points in shares of the side."""
    unused = jnp.zeros((1, 1, 3), points.dtype)
    data = FitInput(
        image=unused,
        mask=unused[..., 0],
        landmarks=points,
        landmark_weight=jnp.ones(68, points.dtype),
        landmark_unit=jnp.linalg.norm(points[36] - points[45]),
        principal=jnp.full(2, 0.5, points.dtype),
        log_focal=jnp.asarray(np.log(2.0), points.dtype),
        log_focal_deviation=jnp.asarray(0.3, points.dtype),
        estimate_inliers=jnp.asarray(False),
    )
    y, _ = fit_landmarks(data, model, weights, config)
    vertices = model.model.shape(y.identity, y.expression)
    screen = y.camera(data.principal).project(y.pose(model.points(vertices)))
    return vertices, screen[:, :2]


class LandmarkFitter:
    """A compiled landmark-only fit of one model to points in a square photo."""

    def __init__(self, model: MorphableModel, size: int) -> None:
        self.model = prepare(model, 68)
        self.size = size
        self._fit = jax.jit(_landmarks_to_shape, static_argnums=3)

    def __call__(self, landmarks: np.ndarray) -> tuple[Array, Array]:
        """Vertices (n, 3) mm and landmarks (68, 2) px of the fit to 68 points (px)."""
        points = jnp.asarray(landmarks / self.size, jnp.float32)
        vertices, screen = self._fit(points, self.model, FitWeights(), FitConfig())
        return vertices, screen * self.size
