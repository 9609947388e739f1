"""A linear (PCA) model: a basis whose columns are one standard deviation long."""

import math

import equinox as eqx
import jax.numpy as jnp

from jaxface._types import Array, Float


class LinearBasis(eqx.Module):
    """Directions of variation of a per-vertex quantity, ``A diag(sigma)`` of Saito 2017, sec. 3.

    Coefficients are counted in standard deviations everywhere, ``z = alpha / sigma``, so that a
    plausible face has ``z ~ N(0, 1)`` and the prior is ``sum z^2``. The paper's own coefficients
    are ``alpha = std * z``.
    """

    basis: Float[Array, "n 3 k"]
    """one standard deviation of each mode, vertex-major (mm for shape, linear RGB for albedo)"""
    std: Float[Array, "k"]
    """standard deviation of each mode in the units of the source model's coefficients"""

    @property
    def count(self) -> int:
        """Number of modes k."""
        return self.basis.shape[-1]

    def __call__(self, z: Float[Array, "k"]) -> Float[Array, "n 3"]:
        """Offset from the mean for coefficients ``z`` (standard deviations)."""
        *per_vertex, count = self.basis.shape
        # The row count is explicit because -1 is undefined for a basis without modes.
        rows = math.prod(per_vertex)
        return jnp.reshape(jnp.reshape(self.basis, (rows, count)) @ z, per_vertex)

    def truncated(self, count: int) -> "LinearBasis":
        """The first ``count`` modes."""
        return LinearBasis(self.basis[..., :count], self.std[:count])


def empty_basis(vertices: int) -> LinearBasis:
    """A basis without modes, for a model that lacks the quantity."""
    return LinearBasis(jnp.zeros((vertices, 3, 0)), jnp.zeros((0,)))
