"""Fit a morphable model to one photo (Saito 2017, section 3, equation 1).

``E = w_c E_c + w_lan E_lan + w_reg E_reg`` over identity, expression, albedo, pose, camera and
light, by damped Gauss-Newton on iteratively reweighted least squares over an image pyramid. The
rasteriser finds what is visible again before every step.
"""

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxface._numerics import safe_norm, safe_normalize
from jaxface._types import Array, Float, Int
from jaxface.energies._photometric_quadratic import normal_modes
from jaxface.energies.landmark import LandmarkData, landmark_difference
from jaxface.energies.photometric import PhotometricData, synthesize
from jaxface.geometry.rotation import rotation_matrix
from jaxface.imaging.pyramid import pyramid
from jaxface.models.parameters import FaceParameters, free_columns, put_together, set_apart
from jaxface.solvers._gauss_newton import Problem, gauss_newton
from jaxface.solvers.solution import Solution
from jaxface.stages.fit._cast_shadows import cast_shadows, shadow_trust
from jaxface.stages.fit.contour import slide_contour
from jaxface.stages.fit.inliers import inlier_weights
from jaxface.stages.fit.objective import fit_energy
from jaxface.stages.fit.prepared import FitModel, in_precision_of
from jaxface.stages.fit.records import (
    FitConfig,
    FitData,
    FitInput,
    FitWeights,
    LevelRecord,
)
from jaxface.stages.fit.samples import thin_samples
from jaxface.stages.fit.visible import visible_samples

TURNED = 0.94
"""cosine of the head's turn from the camera (20 degrees) up to which landmarks count fully"""


def fit_shadows(
    y: FaceParameters,
    data: FitInput,
    model: FitModel,
    coarsest: FitModel,
    config: FitConfig,
    *,
    level: int,
) -> tuple[FaceParameters, Float[Array, "n 9"], Float[Array, "n 3 9"]]:
    """Light, the transfer of its cast shadows, and its slope, from the fit of the level before."""
    y, data = in_precision_of(model, (y, data))
    image, mask, _ = level_image(data, len(config.steps), level, level_side(data, config, level))
    return cast_shadows(
        y, image, mask, data, model, coarsest.model, directions=config.shadow_directions,
        hold_light="light" in config.freeze,
    )  # fmt: skip


def fit_level(
    y: FaceParameters,
    data: FitInput,
    model: FitModel,
    weights: FitWeights,
    config: FitConfig,
    level: int | Int[Array, ""],
    *,
    canvas: int,
) -> tuple[FaceParameters, LevelRecord]:
    """One pyramid level (0 is the coarsest) from the parameters of the last.

    Args:
        y: where the level before ended.
        data: the photo.
        model: level of detail.
        weights: of the terms.
        config: settings.
        level: may be traced, so that levels of one mesh share a program.
        canvas: side (px) that the level's image is filled up to, at least its own.
    """
    y, data, weights = in_precision_of(model, (y, data, weights))
    energy = fit_energy(None, config.extra_terms, config.freeze)
    image, mask, side = level_image(data, len(config.steps), level, canvas)
    modes = normal_modes(y, model.model, model.stencil)
    free, held = set_apart(y, config.freeze)

    def refresh(free, args):
        held, *rest = args
        return observe(put_together(free, held), *rest, config=config)

    solution = gauss_newton(
        Problem(energy.value, energy.quadratic, refresh),
        free,
        (held, image, mask, side, data, model, modes, weights),
        steps=max(config.steps),
        limit=jnp.asarray(config.steps)[level],
        rtol=config.rtol,
    )
    return put_together(solution.value, held), record_of(solution, y, config)


def record_of(solution: Solution, y: FaceParameters, config: FitConfig) -> LevelRecord:
    """What a level's solver tells, its curvature for all unknowns."""
    stats = solution.stats
    curvature = stats["curvature"]
    if config.freeze:
        kept, count = free_columns(y, config.freeze), sum(x.size for x in jax.tree.leaves(y))
        whole = jnp.zeros((count, count), curvature.dtype)
        curvature = whole.at[kept[:, None], kept].set(curvature)
    return LevelRecord(stats["history"], stats["num_steps"], curvature, stats["not_finite"])


def level_side(data: FitInput, config: FitConfig, level: int) -> int:
    """Side of a level's image, px."""
    return data.image.shape[0] >> (len(config.steps) - 1 - level)


def level_image(
    data: FitInput, levels: int, level: int | Int[Array, ""], canvas: int
) -> tuple[Float[Array, "s s 3"], Float[Array, "s s"], Float[Array, ""]]:
    """A level's image and mask, filled up with zeros to a canvas, and its own side in px."""
    both = jnp.concatenate([data.image, data.mask[..., None]], axis=-1)
    held = [shrunk for shrunk in pyramid(both, levels)[::-1] if len(shrunk) <= canvas]
    filled = jnp.stack([jnp.pad(x, [(0, canvas - len(x))] * 2 + [(0, 0)]) for x in held])[level]
    side = jnp.array([len(x) for x in held], filled.dtype)[level]
    return filled[..., :3], filled[..., 3], side


def observe(
    y: FaceParameters,
    image: Float[Array, "s s 3"],
    mask: Float[Array, "s s"],
    side: float | Float[Array, ""],
    data: FitInput,
    model: FitModel,
    modes: Float[Array, "n 3 k"],
    weights: FitWeights,
    *,
    config: FitConfig,
) -> FitData:
    """What is visible at ``y``: the pixel lists and where contour landmarks attach.

    No gradient passes but to the values of frozen unknowns: visibility and inliers are choices,
    held fixed by every derivative.

    Args:
        y: the unknowns.
        image: linear RGB; beyond ``side`` rows and columns it is empty.
        mask: valid face pixels, 0 to 1, and 0 beyond ``side``.
        side: of the working image at this level, px.
        data: the photo's landmarks and camera.
        model: level of detail.
        modes: derivative of the vertex normals along the shape modes (``normal_modes``).
        weights: of the terms.
        config: how many pixels are compared, what is frozen, whether contours slide.
    """
    _, held = set_apart(y, config.freeze)
    y = jax.lax.stop_gradient(y)
    samples = visible_samples(y, image, mask, side, data, model, config.compared_pixels)
    trusted = shadow_trust(y, model.model, samples)
    samples = eqx.tree_at(lambda s: s.weight, samples, samples.weight * trusted)
    synth = synthesize(y, model.model, samples)
    inlier = inlier_weights(samples.color, synth, samples.weight)
    inlier = jnp.where(data.estimate_inliers, inlier, 1.0)
    samples = eqx.tree_at(lambda s: s.weight, samples, samples.weight * inlier)
    misfit = jnp.sum(samples.weight * safe_norm(samples.color - synth))
    misfit = misfit / jnp.maximum(jnp.sum(samples.weight), 1.0)
    trust = weights.noise / jnp.maximum(misfit, 0.2 * weights.noise + 1e-9)
    landmark = landmarks_at(y, data, model, config)
    distance = safe_norm(landmark_difference(y, landmark)) / landmark.unit
    scale = jnp.asarray(weights.landmark_scale, distance.dtype)
    outlier = jnp.where(scale > 0, distance / jnp.where(scale > 0, scale, 1.0), 0.0)
    robust = landmark.weight / (1.0 + outlier**2)
    return FitData(
        photo=PhotometricData(model.model, samples),
        photo_trust=jnp.where(weights.noise > 0, trust, 1.0),
        curvature_samples=thin_samples(samples, config.curvature_pixels),
        landmark=eqx.tree_at(lambda d: d.weight, landmark, robust),
        landmark_trust=landmark_trust(y, weights.landmark_turn),
        normal_modes=modes,
        focal_prior=(data.log_focal, data.log_focal_deviation),
        weights=weights,
        user=data.user,
        held=held,
    )


def observe_finest(
    y: FaceParameters, data: FitInput, model: FitModel, weights: FitWeights, config: FitConfig
) -> FitData:
    """``observe`` on the whole working image: what a step from ``y`` on the last level holds fixed.

    Args:
        y: the unknowns.
        data: the photo.
        model: the finest level of detail.
        weights: of the terms.
        config: how many pixels are compared.
    """
    modes = normal_modes(y, model.model, model.stencil)
    side = jnp.asarray(len(data.image), data.image.dtype)
    return observe(y, data.image, data.mask, side, data, model, modes, weights, config=config)


def landmark_trust(y: FaceParameters, power: float | Float[Array, ""]) -> Float[Array, ""]:
    """How much the landmark term counts, by the head's turn: 1 up to that of ``TURNED``.

    On renders of known faces the detector's error is 1.4 times as large at 40 degrees as at 20.
    """
    to_camera = -safe_normalize(y.translation)
    front = rotation_matrix(y.rotation)[:, 2] @ to_camera  # +z of the model comes out of the face
    return jnp.clip(front / TURNED, 0.1, 1.0) ** power


def landmarks_at(
    y: FaceParameters, data: FitInput, model: FitModel, config: FitConfig
) -> LandmarkData:
    """The landmarks as a step from ``y`` compares them."""
    landmarks = landmark_data(data, model)
    if not config.follow_contour:
        return landmarks
    return slide_contour(y, landmarks, model.contour, model.outline)


def landmark_data(data: FitInput, model: FitModel) -> LandmarkData:
    """Landmarks at their own places on the mesh, before contours slide."""
    return LandmarkData(
        model=model.model,
        points=model.points,
        target=data.landmarks,
        weight=data.landmark_weight,
        principal=data.principal,
        unit=data.landmark_unit,
    )
