"""Array types used in every public signature.

Shapes are written with jaxtyping, e.g. ``Float[Array, "n 3"]``. Lengths are millimetres,
angles radians, image coordinates pixels with the origin at the top-left corner and pixel
centres at +0.5 (x right, y down), colours linear-light RGB unless a name says otherwise.
"""

from jax import Array
from jaxtyping import Bool, Float, Int, PyTree, Shaped

__all__ = ["Array", "Bool", "Float", "Int", "PyTree", "Shaped"]
