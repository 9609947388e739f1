"""Fit a morphable model to one photo (Saito 2017, section 3, equation 1).

``E = w_c E_c + w_lan E_lan + w_reg E_reg`` over identity, expression, albedo, pose, camera and
light, by damped Gauss-Newton on iteratively reweighted least squares over an image pyramid. The
rasteriser finds what is visible again before every step.
"""

import operator
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxface._numerics import safe_norm, safe_normalize, safe_sqrt
from jaxface._types import Array, Float, Int
from jaxface.energies._photometric_quadratic import normal_modes, photometric_quadratic
from jaxface.energies.landmark import LandmarkData, landmark_difference, landmark_residual
from jaxface.energies.photometric import PhotometricData, photometric_energy, synthesize
from jaxface.energies.prior import focal_residual, light_residual, prior_residual
from jaxface.energies.term import Energy, Quadratic, Term, compose
from jaxface.geometry.mesh import vertex_normals
from jaxface.geometry.pose import pose_from_landmarks
from jaxface.geometry.rotation import rotation_matrix
from jaxface.imaging.pyramid import pyramid
from jaxface.imaging.resample import bilinear
from jaxface.models.parameters import FaceParameters, neutral_parameters
from jaxface.render.occlusion import sh_rotation
from jaxface.render.shading import sh_basis
from jaxface.solvers._gauss_newton import Problem, gauss_newton
from jaxface.solvers.solution import Solution
from jaxface.stages.fit._cast_shadows import cast_shadows, shadow_trust
from jaxface.stages.fit.contour import slide_contour
from jaxface.stages.fit.inliers import inlier_weights
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


def fit_energy(weights: FitWeights | None = None, extra_terms: Sequence[Term] = ()) -> Energy:
    """Equation 1 of Saito 2017 as composed terms of ``(FaceParameters, FitData)``.

    Args:
        weights: of the terms; by default those in the data, with respect to which a fit can then
            be differentiated.
        extra_terms: your own.
    """
    return compose(
        [
            Term("photo", _photo_value, _weight(weights, "photo"), "scalar", _photo_quadratic),
            *_geometric_terms(weights),
            Term("light", lambda y, d: light_residual(y), _weight(weights, "light")),
            *extra_terms,
        ]
    )


def _weight(weights: FitWeights | None, name: str) -> Any:
    return operator.attrgetter(f"weights.{name}") if weights is None else getattr(weights, name)


def _photo_value(y: FaceParameters, data: FitData) -> Float[Array, ""]:
    return data.photo_trust * photometric_energy(y, data.photo)


def _photo_quadratic(y: FaceParameters, data: FitData) -> Quadratic:
    model = photometric_quadratic(y, data.photo, data.normal_modes, data.curvature_samples)
    return jax.tree.map(lambda x: data.photo_trust * x, model)


def _geometric_terms(weights: FitWeights | None = None) -> list[Term]:
    def landmark(y: FaceParameters, d: FitData) -> Array:
        return safe_sqrt(d.landmark_trust) * landmark_residual(y, d.landmark)

    def focal(y: FaceParameters, d: FitData) -> Array:
        return focal_residual(y, d.focal_prior)

    return [
        Term("landmark", landmark, _weight(weights, "landmark")),
        Term("prior", lambda y, d: prior_residual(y), _weight(weights, "prior")),
        Term("focal", focal, _weight(weights, "focal")),
    ]


def fit_start(
    data: FitInput, model: FitModel, weights: FitWeights, config: FitConfig
) -> tuple[FaceParameters, LevelRecord]:
    """Before the first level: pose and coefficients from the landmarks, light in closed form."""
    data, weights = in_precision_of(model, (data, weights))
    y, record = fit_landmarks(data, model, weights, config)
    image, mask, _ = level_image(data, len(config.steps), 0, level_side(data, config, 0))
    return initial_light(y, image, mask, data, model), record


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
        y, image, mask, data, model, coarsest.model, directions=config.shadow_directions
    )


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
    energy = fit_energy(None, config.extra_terms)
    problem = Problem(
        energy=energy.value,
        quadratic=energy.quadratic,
        refresh=lambda y, args: observe(y, *args, config=config),
    )
    image, mask, side = level_image(data, len(config.steps), level, canvas)
    modes = normal_modes(y, model.model, model.stencil)
    solution = gauss_newton(
        problem,
        y,
        (image, mask, side, data, model, modes, weights),
        steps=max(config.steps),
        limit=jnp.asarray(config.steps)[level],
        rtol=config.rtol,
    )
    return solution.value, _record(solution)


def _record(solution: Solution) -> LevelRecord:
    stats = solution.stats
    return LevelRecord(stats["history"], stats["num_steps"], stats["curvature"])


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

    No gradient passes: visibility and inliers are choices, held fixed by every derivative.

    Args:
        y: the unknowns.
        image: linear RGB; beyond ``side`` rows and columns it is empty.
        mask: valid face pixels, 0 to 1, and 0 beyond ``side``.
        side: of the working image at this level, px.
        data: the photo's landmarks and camera.
        model: level of detail.
        modes: derivative of the vertex normals along the shape modes (``normal_modes``).
        weights: of the terms.
        config: how many pixels are compared.
    """
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
    landmark = slide_contour(y, landmark_data(data, model), model.contour, model.outline)
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
    )


def landmark_trust(y: FaceParameters, power: float | Float[Array, ""]) -> Float[Array, ""]:
    """How much the landmark term counts, by the head's turn: 1 up to that of ``TURNED``.

    On renders of known faces the detector's error is 1.4 times as large at 40 degrees as at 20.
    """
    to_camera = -safe_normalize(y.translation)
    front = rotation_matrix(y.rotation)[:, 2] @ to_camera  # +z of the model comes out of the face
    return jnp.clip(front / TURNED, 0.1, 1.0) ** power


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


def fit_landmarks(
    data: FitInput, model: FitModel, weights: FitWeights, config: FitConfig
) -> tuple[FaceParameters, LevelRecord]:
    """Closed-form pose, then pose, camera and coefficients from landmarks and prior alone."""
    y = neutral_parameters(model.model)
    y = eqx.tree_at(lambda p: p.log_focal, y, data.log_focal)
    # The outline moves with the viewpoint; the inner points alone give a steadier first pose.
    inner = data.landmark_weight.at[model.contour].set(0.0)
    rotation, translation = pose_from_landmarks(
        model.points(model.model.mean),
        data.landmarks,
        inner,
        jnp.exp(data.log_focal),
        data.principal,
    )
    y = eqx.tree_at(lambda p: (p.rotation, p.translation), y, (rotation, translation))
    energy = compose(_geometric_terms())

    def refresh(y, args):
        data, model, weights = args
        return _GeometricData(
            slide_contour(y, landmark_data(data, model), model.contour, model.outline),
            jnp.ones((), y.light.dtype),
            (data.log_focal, data.log_focal_deviation),
            weights,
        )

    problem = Problem(energy.value, energy.quadratic, refresh)
    solution = gauss_newton(
        problem, y, (data, model, weights), steps=config.landmark_steps, rtol=config.rtol
    )
    return solution.value, _record(solution)


class _GeometricData(eqx.Module):
    landmark: LandmarkData
    landmark_trust: Array
    focal_prior: tuple[Array, Array]
    weights: FitWeights


def initial_light(
    y: FaceParameters,
    image: Float[Array, "s s 3"],
    mask: Float[Array, "s s"],
    data: FitInput,
    model: FitModel,
) -> FaceParameters:
    """Light in closed form: linear least squares over the vertices, shape and albedo held.

    Vertices count by how much they face the camera; whether another part of the face hides them
    from it is ignored, which is good enough for a start. The upper bands are damped (a ridge of
    0.02 of the ambient column), as a face shows only half the sphere of normals.
    """
    size = image.shape[0]
    shape = model.model.shape(y.identity, y.expression)
    rotation = rotation_matrix(y.rotation)
    normal = vertex_normals(shape, model.model.faces) @ rotation.T
    posed = y.pose(shape)
    view = -safe_normalize(posed)
    facing = jnp.maximum(jnp.sum(normal * view, axis=-1) - 0.2, 0.0)
    screen = y.camera(data.principal, size).project(posed)[:, :2]
    seen = bilinear(jnp.concatenate([image, mask[..., None]], axis=-1), screen)
    weight = facing * seen[:, 3] * model.vertex_mask
    weight = weight / jnp.maximum(jnp.sum(weight), 1e-6)
    harmonics = sh_basis(normal)
    if model.model.occlusion is not None:
        harmonics = harmonics + model.model.occlusion @ sh_rotation(rotation).T
    columns = harmonics[:, None, :] * model.model.reflectance(y.albedo)[:, :, None]
    gram = jnp.einsum("n,nci,ncj->cij", weight, columns, columns)
    rhs = jnp.einsum("n,nci,nc->ci", weight, columns, seen[:, :3])
    ridge = jnp.diag(jnp.array([1e-4] + [0.02] * 8, gram.dtype))
    gram = gram + ridge * jnp.maximum(gram[:, :1, :1], 1e-6)
    light = jnp.linalg.solve(gram, rhs[..., None])[..., 0].T
    return eqx.tree_at(lambda p: p.light, y, light)
