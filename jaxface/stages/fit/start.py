"""Where a fit begins: pose and coefficients from the landmarks, light in closed form."""

import equinox as eqx
import jax.numpy as jnp

from jaxface._numerics import safe_normalize
from jaxface._types import Array, Float
from jaxface.energies.landmark import LandmarkData
from jaxface.geometry.mesh import vertex_normals
from jaxface.geometry.pose import pose_from_landmarks
from jaxface.geometry.rotation import rotation_matrix
from jaxface.imaging.resample import bilinear
from jaxface.models.parameters import FaceParameters, neutral_parameters, put_together, set_apart
from jaxface.render.occlusion import sh_rotation
from jaxface.render.shading import sh_basis
from jaxface.solvers._gauss_newton import Problem, gauss_newton
from jaxface.stages.fit.objective import geometric_energy
from jaxface.stages.fit.prepared import FitModel, in_precision_of
from jaxface.stages.fit.records import FitConfig, FitInput, FitWeights, LevelRecord
from jaxface.stages.fit.solve import (
    landmarks_at,
    level_image,
    level_side,
    record_of,
)


def fit_start(
    data: FitInput, model: FitModel, weights: FitWeights, config: FitConfig
) -> tuple[FaceParameters, LevelRecord]:
    """Before the first level: pose and coefficients from the landmarks, light in closed form."""
    data, weights = in_precision_of(model, (data, weights))
    y, record = fit_landmarks(data, model, weights, config)
    image, mask, _ = level_image(data, len(config.steps), 0, level_side(data, config, 0))
    return initial_light(y, image, mask, data, model), record


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
    energy = geometric_energy(config.freeze)
    free, held = set_apart(y, config.freeze)
    # A fit to the photo alone needs a start as well: without a weight landmarks have the usual one.
    weight = jnp.asarray(weights.landmark, y.light.dtype)
    usual = jnp.where(weight > 0, weight, FitWeights().landmark)
    weights = eqx.tree_at(lambda w: w.landmark, weights, usual)

    def refresh(free, args):
        held, data, model, weights = args
        return _GeometricData(
            landmarks_at(put_together(free, held), data, model, config),
            jnp.ones((), data.landmarks.dtype),
            (data.log_focal, data.log_focal_deviation),
            weights,
            held,
        )

    problem = Problem(energy.value, energy.quadratic, refresh)
    solution = gauss_newton(
        problem,
        free,
        (held, data, model, weights),
        steps=config.landmark_steps,
        rtol=config.rtol,
    )
    return put_together(solution.value, held), record_of(solution, y, config)


class _GeometricData(eqx.Module):
    landmark: LandmarkData
    landmark_trust: Array
    focal_prior: tuple[Array, Array]
    weights: FitWeights
    held: FaceParameters | None


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
