"""Regularisation ``E_reg`` (Saito 2017, section 3) and the prior on the focal length."""

import jax.numpy as jnp

from jaxface._types import Array, Float, PyTree
from jaxface.models.parameters import FaceParameters


def prior_residual(y: FaceParameters, args: PyTree = None) -> dict[str, Float[Array, "_"]]:
    """Residuals with ``||r||^2 = E_reg = sum (alpha_i / sigma_i)^2`` over all coefficients.

    Coefficients are counted in standard deviations, so they are their own residuals.
    """
    del args
    return {"identity": y.identity, "expression": y.expression, "albedo": y.albedo}


def focal_residual(
    y: FaceParameters, args: tuple[Float[Array, ""], Float[Array, ""]]
) -> Float[Array, ""]:
    """``(log f - log f_0) / sigma``, a Gaussian prior on the logarithm of the focal length.

    Not in the paper, which leaves P free: one face hardly constrains the focal length (size
    and distance trade against it), so a weak prior keeps it where portraits are taken.

    Args:
        y: the unknowns.
        args: (log f_0, sigma).
    """
    centre, deviation = args
    return (y.log_focal - centre) / deviation


def light_residual(y: FaceParameters, args: PyTree = None) -> Float[Array, "8 3"]:
    """Higher-order light over the ambient one's mean: ``||r||^2 = sum L_{1..8}^2 / mean(L_0)^2``.

    Not in the paper. With a small weight it settles the light where the visible normals do not.
    """
    del args
    ambient = jnp.mean(y.light[0])
    scale = jnp.where(jnp.abs(ambient) > 1e-3, ambient, 1e-3)
    return y.light[1:] / scale
