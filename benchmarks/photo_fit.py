"""One photo to an `Estimate`, by the stages of the package: detect, crop, fit."""

import time

import jax
import jax.numpy as jnp
import numpy as np
from fit_metrics import Estimate

from jaxface.geometry.rotation import rotation_matrix
from jaxface.imaging.colour import srgb_to_linear
from jaxface.imaging.masks import face_oval_mask
from jaxface.models.landmark_schemes import landmarks68
from jaxface.models.morphable import MorphableModel
from jaxface.models.subdivide import subdivide
from jaxface.stages.crop import Crop, crop_face
from jaxface.stages.fit import FitConfig, FitInput, FitWeights, fit_input_to_parameters
from jaxface.stages.fit_model import prepare
from jaxface.stages.landmarks import detect_one

EYE_CORNERS = (33, 263)  # outer, of the 468 points


class PhotoFitter:
    """A compiled fit of one model."""

    def __init__(
        self,
        model: MorphableModel,
        levels: tuple[int, ...] = (0, 1, 2),
        size: int = 512,
        config: FitConfig | None = None,
        weights: FitWeights | None = None,
    ) -> None:
        self.count = 68 if model.landmarks468 is None else 468
        refined = {level: prepare(subdivide(model, level), self.count) for level in set(levels)}
        self.models = tuple(refined[level] for level in levels)
        self.size = size
        self.config = config or FitConfig()
        self.weights = weights or FitWeights()
        self._fit = jax.jit(fit_input_to_parameters, static_argnums=3)

    def prepare(self, photo: np.ndarray) -> tuple[FitInput, Crop, np.ndarray]:
        """Working image and landmarks of a photo (uint8 sRGB); and the 68 landmarks in it, px."""
        points = np.asarray(detect_one(photo).landmarks, np.float32)
        inner = np.asarray(landmarks68(jnp.asarray(points)))[:, :2]
        linear = np.asarray(srgb_to_linear(photo.astype(np.float32) / 255))
        crop = crop_face(linear, points[:, :2], self.size)
        inside = crop.to_crop(points).astype(np.float32)
        mask = face_oval_mask(jnp.asarray(inside * self.size), self.size, self.size)
        mask = np.asarray(mask) * crop.inside
        target = inside if self.count == 468 else crop.to_crop(inner).astype(np.float32)
        unit = np.linalg.norm(inside[EYE_CORNERS[0]] - inside[EYE_CORNERS[1]])
        height, width = photo.shape[:2]
        gain = 0.5 / np.median(crop.image[mask > 0])
        data = FitInput(
            image=jnp.asarray(crop.image * gain),
            mask=jnp.asarray(mask, jnp.float32),
            landmarks=jnp.asarray(target),
            landmark_weight=jnp.ones(len(target)),
            landmark_unit=jnp.asarray(unit, jnp.float32),
            principal=jnp.asarray(crop.to_crop(np.array([width / 2, height / 2])), jnp.float32),
            log_focal=jnp.asarray(np.log(1.4 * max(height, width) / crop.side), jnp.float32),
            log_focal_deviation=jnp.asarray(0.3),
            estimate_inliers=jnp.asarray(True),
        )
        return data, crop, inner

    def __call__(self, photo: np.ndarray) -> Estimate:
        """Fit a photo (uint8 sRGB)."""
        data, crop, detected = self.prepare(photo)
        start = time.perf_counter()
        y = jax.block_until_ready(self._fit(data, self.models, self.weights, self.config))[0]
        seconds = time.perf_counter() - start
        model = self.models[-1].model
        points = y.pose(model.landmarks68(model.shape(y.identity, y.expression)))
        screen = np.asarray(y.camera(data.principal).project(points))[:, :2]
        return Estimate(
            identity=np.asarray(y.identity),
            expression=np.asarray(y.expression),
            albedo=np.asarray(y.albedo),
            light=np.asarray(y.light),
            rotation=np.asarray(rotation_matrix(y.rotation)),
            landmarks=crop.to_photo(screen),
            detected=detected,
            seconds=seconds,
        )
