"""The rotation nearest to a matrix, with derivatives that singular vectors do not have.

The rotation ``R`` that maximises ``tr(R^T M)`` comes from a singular value decomposition, whose
vectors have no derivative where two singular values are equal. The rotation has one: with the
symmetric ``P = R^T M`` a change of the matrix turns it by ``dR = R [w]x``, where

``(tr(P) I - P) w = vee(R^T dM - dM^T R)``.

It exists unless the two smallest singular values (the last with the sign of the determinant)
add up to zero: then the nearest rotation is not unique, and its derivative is taken as zero.
"""

import jax
import jax.numpy as jnp

from jaxface._types import Array, Float


@jax.custom_jvp
def nearest_rotation(matrix: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """The rotation R (determinant +1) that maximises ``tr(R^T M)``.

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns",
    PAMI 1991, lemma. Of several equally near ones the decomposition's order decides.
    """
    u, _, vt = jnp.linalg.svd(matrix)
    sign = jnp.ones(3, matrix.dtype).at[2].set(jnp.linalg.det(u) * jnp.linalg.det(vt))
    return (u * sign) @ vt


@nearest_rotation.defjvp
def _nearest_rotation_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (matrix,), (change,) = primals, tangents
    rotation = nearest_rotation(matrix)
    return rotation, rotation_change(rotation, matrix, change)


def rotation_change(
    rotation: Float[Array, "3 3"], matrix: Float[Array, "3 3"], change: Float[Array, "3 3"]
) -> Float[Array, "3 3"]:
    """Change of the rotation nearest to a matrix with the matrix.

    Args:
        rotation: R, the nearest to ``matrix``.
        matrix: M.
        change: dM, in which the result is linear.
    """
    stretch = rotation.T @ matrix
    stretch = 0.5 * (stretch + stretch.T)
    system = jnp.trace(stretch) * jnp.eye(3, dtype=matrix.dtype) - stretch
    size = jnp.max(jnp.abs(system))
    unique = jnp.abs(jnp.linalg.det(system)) > 100 * jnp.finfo(matrix.dtype).eps * size**3
    system = jnp.where(unique, system, jnp.eye(3, dtype=matrix.dtype))
    moved = rotation.T @ change
    moved = moved - moved.T
    turn = jnp.linalg.solve(system, jnp.stack([moved[2, 1], moved[0, 2], moved[1, 0]]))
    x, y, z = jnp.where(unique, turn, 0.0)
    zero = jnp.zeros_like(x)
    return rotation @ jnp.stack(
        [jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])]
    )
