"""Fit a morphable model to one photo (Saito 2017, section 3, equation 1).

``E = w_c E_c + w_lan E_lan + w_reg E_reg`` over identity, expression, albedo, pose, camera and
light, by damped Gauss-Newton on iteratively reweighted least squares over an image pyramid. The
rasteriser finds what is visible again before every step.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxface._numerics import safe_norm
from jaxface._types import Array, Float
from jaxface.energies.landmark import (
    LandmarkData,
    landmark_difference,
    landmark_residual,
    slide_contour,
)
from jaxface.energies.photometric import (
    PhotometricData,
    PixelSamples,
    photometric_energy,
    sample_pixels,
    synthesize,
    thin_samples,
)
from jaxface.energies.photometric_quadratic import normal_modes, photometric_quadratic
from jaxface.energies.prior import focal_residual, light_residual, prior_residual
from jaxface.energies.term import Energy, Quadratic, Term, compose
from jaxface.geometry.mesh import vertex_normals
from jaxface.geometry.pose import pose_from_landmarks
from jaxface.geometry.rotation import rotation_matrix
from jaxface.imaging.pyramid import pyramid
from jaxface.imaging.resample import bilinear
from jaxface.models.parameters import FaceParameters, neutral_parameters
from jaxface.render.rasterize import rasterize
from jaxface.render.shading import sh_basis
from jaxface.solvers.gauss_newton import Problem, gauss_newton
from jaxface.stages.fit.inliers import inlier_weights
from jaxface.stages.fit.prepared import FitModel


class FitWeights(eqx.Module):
    """Weights of the terms; the first three as in Saito 2017."""

    photo: float | Array = 1.0
    landmark: float | Array = 10.0
    prior: float | Array = 2.5e-5
    noise: float | Array = 0.03
    """``E_c`` (linear RGB, face at median 0.5) at which the photo term has its own weight: it
    counts ``noise / E_c``, the more the better the model explains the photo; 0 gives the paper's
    constant weight"""
    landmark_scale: float | Array = 0.025
    """distance (of the eye distance) at which a landmark counts half, as an outlier does; 0
    gives the paper's plain squares"""
    focal: float | Array = 2.5e-5
    """of the prior on the focal length (not in the paper)"""
    light: float | Array = 2.5e-5
    """of the damping of the light's upper bands (not in the paper)"""


class FitConfig(eqx.Module):
    """Settings of a fit that are fixed at compile time."""

    steps: tuple[int, ...] = eqx.field(static=True, default=(30, 10, 3))
    """Gauss-Newton steps on each pyramid level, coarsest first"""
    landmark_steps: int = eqx.field(static=True, default=15)
    """steps on landmarks and prior alone, before the first level"""
    curvature_pixels: int = eqx.field(static=True, default=6000)
    """pixels (evenly spread) on which the Jacobian is formed; the gradient uses all"""
    rtol: float = eqx.field(static=True, default=1e-5)
    extra_terms: tuple[Term, ...] = eqx.field(static=True, default=())
    """your own terms, functions of ``(FaceParameters, FitData)``"""


class FitInput(eqx.Module):
    """One photo, cut to the working image, and what was detected on it."""

    image: Float[Array, "s s 3"]
    """linear RGB"""
    mask: Float[Array, "s s"]
    """valid face pixels, 0 to 1"""
    landmarks: Float[Array, "l 2"]
    """(x, y) as fractions of the side"""
    landmark_weight: Float[Array, "l"]
    landmark_unit: Float[Array, ""]
    """outer eye corners' distance, as a fraction of the side"""
    principal: Float[Array, "2"]
    """principal point, as fractions of the side"""
    log_focal: Float[Array, ""]
    """prior mean of the logarithm of the focal length over the side"""
    log_focal_deviation: Float[Array, ""]
    estimate_inliers: Array
    """True: hair, hands and glasses are looked for in the mask; False: the mask is trusted"""


class FitData(eqx.Module):
    """What one Gauss-Newton step holds fixed: visible pixels, landmarks, priors."""

    photo: PhotometricData
    photo_trust: Float[Array, ""]
    """``noise / E_c``: a Laplacian of unknown width has ``log E_c`` for its likelihood"""
    curvature_samples: PixelSamples
    landmark: LandmarkData
    normal_modes: Float[Array, "n 3 k"]
    """derivative of the vertex normals along the shape modes, from the start of the level"""
    focal_prior: tuple[Array, Array]


class FitStats(eqx.Module):
    """History of a fit, one entry a level (the first is the landmark-only start)."""

    energies: tuple[dict[str, Array], ...]
    """per level: (steps + 1,) energy of every term before each step and after the last"""
    steps: tuple[Array, ...]
    """steps used on each level"""
    curvature: Float[Array, "p p"]
    """of the energy, from the last step of the finest level: half its Gauss-Newton Hessian"""


def fit_energy(weights: FitWeights, extra_terms: Sequence[Term] = ()) -> Energy:
    """Equation 1 of Saito 2017 as composed terms of ``(FaceParameters, FitData)``."""
    return compose(
        [
            Term("photo", _photo_value, weights.photo, "scalar", _photo_quadratic),
            *_geometric_terms(weights),
            Term("light", lambda y, d: light_residual(y), weights.light),
            *extra_terms,
        ]
    )


def _photo_value(y: FaceParameters, data: FitData) -> Float[Array, ""]:
    return data.photo_trust * photometric_energy(y, data.photo)


def _photo_quadratic(y: FaceParameters, data: FitData) -> Quadratic:
    model = photometric_quadratic(y, data.photo, data.normal_modes, data.curvature_samples)
    return jax.tree.map(lambda x: data.photo_trust * x, model)


def _geometric_terms(weights: FitWeights) -> list[Term]:
    return [
        Term("landmark", lambda y, d: landmark_residual(y, d.landmark), weights.landmark),
        Term("prior", lambda y, d: prior_residual(y), weights.prior),
        Term("focal", lambda y, d: focal_residual(y, d.focal_prior), weights.focal),
    ]


def fit_parameters(
    data: FitInput,
    models: tuple[FitModel, ...],
    weights: FitWeights,
    config: FitConfig,
) -> tuple[FaceParameters, FitStats]:
    """The whole fit as one pure function: jit it, vmap it over ``data``.

    Args:
        data: working image and landmarks.
        models: the model at each level of detail, coarsest first, one for each pyramid level.
        weights: term weights.
        config: steps and sizes.

    Returns:
        The parameters and the history.
    """
    y, landmark_history = _fit_landmarks(data, models[0], weights, config)
    energy = fit_energy(weights, config.extra_terms)
    levels = len(config.steps)
    images = pyramid(data.image, levels)[::-1]
    masks = [m[..., 0] for m in pyramid(data.mask[..., None], levels)[::-1]]
    y = initial_light(y, images[0], masks[0], data, models[0])
    histories, used = [landmark_history[0]], [landmark_history[1]]
    for image, mask, model, steps in zip(images, masks, models, config.steps, strict=True):
        problem = Problem(
            energy=energy.value,
            quadratic=energy.quadratic,
            refresh=lambda y, args: observe(y, *args, curvature_pixels=config.curvature_pixels),
        )
        modes = normal_modes(y, model.model, model.stencil)
        args = (image, mask, data, model, modes, weights)
        solution = gauss_newton(problem, y, args, steps=steps, rtol=config.rtol)
        y = solution.value
        histories.append(solution.stats["history"])
        used.append(solution.stats["num_steps"])
        curvature = solution.stats["curvature"]
    return y, FitStats(tuple(histories), tuple(used), curvature)


def observe(
    y: FaceParameters,
    image: Float[Array, "s s 3"],
    mask: Float[Array, "s s"],
    data: FitInput,
    model: FitModel,
    modes: Float[Array, "n 3 k"],
    weights: FitWeights,
    *,
    curvature_pixels: int,
) -> FitData:
    """What is visible at ``y``: the pixel lists and where contour landmarks attach.

    No gradient passes: visibility and inliers are choices, held fixed by every derivative.
    """
    y = jax.lax.stop_gradient(y)
    size = image.shape[0]
    triangle = visible_triangles(y, model, data.principal, size)
    faces = model.model.faces

    samples = sample_pixels(
        image, mask, triangle, faces, model.face_mask, data.principal, size * size // 2
    )
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
        curvature_samples=thin_samples(samples, curvature_pixels),
        landmark=eqx.tree_at(lambda d: d.weight, landmark, robust),
        normal_modes=modes,
        focal_prior=(data.log_focal, data.log_focal_deviation),
    )


def visible_triangles(
    y: FaceParameters, model: FitModel, principal: Float[Array, "2"], size: int
) -> Array:
    """(s, s) index of the triangle each pixel shows, -1 for none; no gradient passes."""
    y = jax.lax.stop_gradient(y)
    vertices = y.pose(model.model.shape(y.identity, y.expression))
    screen = y.camera(principal, size).project(vertices)
    return rasterize(screen, model.model.faces, size, size, cull=True).triangle


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


def _fit_landmarks(data: FitInput, model: FitModel, weights: FitWeights, config: FitConfig):
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
    energy = compose(_geometric_terms(weights))

    def refresh(y, args):
        data, model = args
        return _GeometricData(
            slide_contour(y, landmark_data(data, model), model.contour, model.outline),
            (data.log_focal, data.log_focal_deviation),
        )

    problem = Problem(energy.value, energy.quadratic, refresh)
    solution = gauss_newton(
        problem, y, (data, model), steps=config.landmark_steps, rtol=config.rtol
    )
    return solution.value, (solution.stats["history"], solution.stats["num_steps"])


class _GeometricData(eqx.Module):
    landmark: LandmarkData
    focal_prior: tuple[Array, Array]


def initial_light(
    y: FaceParameters,
    image: Float[Array, "s s 3"],
    mask: Float[Array, "s s"],
    data: FitInput,
    model: FitModel,
) -> FaceParameters:
    """Light in closed form: linear least squares over the vertices, shape and albedo held.

    Vertices count by how much they face the camera; occlusion is ignored, which is good enough
    for a start. The upper bands are damped (a ridge of 0.02 of the ambient column), as a face
    shows only half the sphere of normals.
    """
    size = image.shape[0]
    shape = model.model.shape(y.identity, y.expression)
    rotation = rotation_matrix(y.rotation)
    normal = vertex_normals(shape, model.model.faces) @ rotation.T
    posed = y.pose(shape)
    view = -posed / jnp.linalg.norm(posed, axis=-1, keepdims=True)
    facing = jnp.maximum(jnp.sum(normal * view, axis=-1) - 0.2, 0.0)
    screen = y.camera(data.principal, size).project(posed)[:, :2]
    seen = bilinear(jnp.concatenate([image, mask[..., None]], axis=-1), screen)
    weight = facing * seen[:, 3] * model.vertex_mask
    weight = weight / jnp.maximum(jnp.sum(weight), 1e-6)
    columns = sh_basis(normal)[:, None, :] * model.model.reflectance(y.albedo)[:, :, None]
    gram = jnp.einsum("n,nci,ncj->cij", weight, columns, columns)
    rhs = jnp.einsum("n,nci,nc->ci", weight, columns, seen[:, :3])
    ridge = jnp.diag(jnp.array([1e-4] + [0.02] * 8, gram.dtype))
    gram = gram + ridge * jnp.maximum(gram[:, :1, :1], 1e-6)
    light = jnp.linalg.solve(gram, rhs[..., None])[..., 0].T
    return eqx.tree_at(lambda p: p.light, y, light)
