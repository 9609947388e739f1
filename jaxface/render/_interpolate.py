"""Per-vertex quantities carried to pixels."""

import jax.numpy as jnp

from jaxface._types import Array, Float, Int
from jaxface.render._rasterize import Fragments


def interpolate(
    values: Float[Array, "n c"], faces: Int[Array, "f 3"], fragments: Fragments
) -> Float[Array, "h w c"]:
    """Perspective-correct interpolation of a per-vertex quantity, zero on the background.

    Differentiable in ``values`` and, through the weights of ``fragments``, in the vertices. Also
    serves quantities indexed otherwise than the vertices (UV corners with their own ``faces``).
    """
    seen = jnp.maximum(fragments.triangle, 0)
    weights = fragments.barycentric[..., None]
    a, b, c = (weights[..., i, :] * values[faces[:, i][seen]] for i in range(3))
    return a + b + c
