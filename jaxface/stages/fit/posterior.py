"""How sure a fit is: posterior covariance of the unknowns and standard deviation of each vertex."""

import equinox as eqx
import jax.numpy as jnp

from jaxface._types import Array, Float
from jaxface.energies.photometric_quadratic import normal_modes, shape_basis
from jaxface.models.parameters import FaceParameters
from jaxface.solvers.gauss_newton import posterior_covariance
from jaxface.stages.fit.prepared import FitModel
from jaxface.stages.fit.solve import FitConfig, FitInput, FitWeights, fit_energy, observe


class Posterior(eqx.Module):
    """Gaussian approximation of what the photo leaves open."""

    covariance: Float[Array, "p p"]
    """of the flattened unknowns, in the order of ``FaceParameters``"""
    vertex_deviation: Float[Array, "n"]
    """mm; root of the summed variances of a vertex's x, y and z in the model's frame"""


def posterior(
    y: FaceParameters,
    data: FitInput,
    model: FitModel,
    weights: FitWeights,
    config: FitConfig,
) -> Posterior:
    """Laplace approximation at the fit (Gauss-Newton Hessian).

    The energy is read as ``E = -2 w_reg log p`` plus a constant: that temperature makes the prior
    term alone the standard normal density of the coefficients which it stands for. The model
    has no outside of its own span, so the deviations say what the photo leaves open *within* the
    model.

    Args:
        y: the fitted parameters.
        data: the fit's input.
        model: the finest level of detail.
        weights: the term weights of the fit.
        config: its settings.
    """
    modes = normal_modes(y, model.model, model.stencil)
    observed = observe(
        y, data.image, data.mask, data, model, modes, curvature_pixels=config.curvature_pixels
    )
    quadratic, _ = fit_energy(weights, config.extra_terms).quadratic(y, observed)
    covariance = posterior_covariance(quadratic.curvature, 2 * weights.prior)
    basis = shape_basis(model.model)
    k = basis.shape[-1]
    shape_covariance = covariance[:k, :k]
    moved = jnp.einsum("nck,kl->ncl", basis, shape_covariance)
    variance = jnp.einsum("ncl,ncl->n", moved, basis)
    return Posterior(covariance, jnp.sqrt(jnp.maximum(variance, 0.0)))
