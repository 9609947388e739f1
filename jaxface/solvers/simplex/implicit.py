"""The derivative of a minimiser over the simplex, by the implicit function theorem.

On the set of positive weights the minimiser solves ``sum_l p_kl . y_l = nu``, ``sum w = 1``;
differentiating these equations gives ``dw`` for any change of the points or of the target, and the
weights at zero stay there (strict complementarity).
"""

from functools import partial

import jax
import jax.numpy as jnp

from jaxface._types import Array, Float

SUPPORT = 256
"""positive weights for which the derivative is computed; for more, as if all were positive"""


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def with_derivative(
    squared: bool,
    weights: Float[Array, " k"],
    objective: Float[Array, ""],
    points: tuple[Float[Array, "k n"], ...],
    target: tuple[Float[Array, " n"], ...],
) -> tuple[Float[Array, " k"], Float[Array, ""]]:
    """The weights and the objective as they are, with their derivatives in points and target.

    The problem is ``min sum_l ||sum_k w_k p_kl - t_l||`` over the simplex, or of the squared norms.
    In forward and in reverse mode.

    Where the minimiser has no derivative, the rule is this. Weights at zero stay at zero, so at
    a vertex the derivative is zero. Where the minimiser is not unique (points in
    special position), the derivative is the shortest. Where the residual of a term vanishes, its
    norm is rounded off within 1e-5 of the points' distance (3e-4 in single precision): the
    derivative then keeps the residual at zero as well as the weights can. More than 256 positive
    weights take the time of all of them.
    """
    return weights, objective


@with_derivative.defjvp
def _jvp(squared: bool, primals: tuple, tangents: tuple) -> tuple:
    weights, objective, points, target = primals
    changes = tangents[2:]
    count = len(weights)

    def derivative(size: int, dpoints: tuple, dtarget: tuple) -> tuple[Array, Array]:
        return _derivative(squared, size, weights, (points, target), (dpoints, dtarget))

    if count <= SUPPORT:
        found = derivative(count, *changes)
    else:
        few = jnp.sum(weights > 0) <= SUPPORT
        branches = (partial(derivative, SUPPORT), partial(derivative, count))
        found = jax.lax.cond(few, *branches, *changes)
    return (weights, objective), (found[0], found[1].astype(objective.dtype))


def _derivative(
    squared: bool, size: int, weights: Array, data: tuple, changes: tuple
) -> tuple[Array, Array]:
    """Changes of weights and objective, for ``size`` positive weights at most."""
    w, chosen = jax.lax.top_k(weights, size)
    near = [p[chosen] - t for p, t in zip(*data, strict=True)]
    units, normals, lengths, inverse = _linearised(squared, near, w)
    slope, change = jnp.zeros_like(w), jnp.zeros((), weights.dtype)
    for p, y, normal, phi, dp, dt in zip(near, units, normals, lengths, *changes, strict=True):
        near_change = dp[chosen] - dt
        dr = w @ near_change
        slope = slope + near_change @ y + p @ ((dr - normal * jnp.dot(normal, dr)) / phi)
        change = change + (2.0 if squared else 1.0) * jnp.dot(y, dr)
    step = -(inverse @ slope).astype(weights.dtype)
    return jnp.zeros_like(weights).at[chosen].set(step, unique_indices=True), change


def _linearised(
    squared: bool, near: list[Array], weights: Array
) -> tuple[list[Array], list[Array], list[Array], Array]:
    """What ``y_l`` is and how it changes, ``dy = (dr - n (n . dr)) / phi``; the inverse Hessian.

    In order: the dual vectors ``y_l``, the directions ``n_l`` in which they are rigid, the lengths
    ``phi_l``, and the inverse of the Hessian along the face of positive weights.

    Points of the face are often close to dependent: the inverse is computed in double precision.
    """
    dtype = weights.dtype
    rounding = float(jnp.finfo(dtype).eps) ** 0.5
    # Stiff terms cost the inverse its digits: the best of softness and rounding in doubles.
    softness = max(rounding, 1e-5)
    with jax.enable_x64(True):
        near, weights = jax.tree.map(
            lambda x: jax.lax.convert_element_type(x, jnp.float64), (near, weights)
        )
        active = weights > 0
        ones = active.astype(weights.dtype)
        face = jnp.outer(ones, ones) / jnp.sum(ones)
        index = jax.lax.iota(jnp.int32, len(weights))
        project = ((index[:, None] == index) & active).astype(weights.dtype) - face
        hessian = jnp.zeros_like(project)
        pull, hidden = jnp.zeros_like(weights), jnp.zeros_like(project)
        units, normals, lengths, kinks = [], [], [], []
        for p in near:
            r = weights @ p
            gram = p @ p.T
            if squared:
                hessian = hessian + gram
                units, normals = [*units, r], [*normals, jnp.zeros_like(r)]
                lengths = [*lengths, jnp.ones_like(r[0])]
                continue
            norm = jnp.linalg.norm(r)
            size = jnp.sqrt(jnp.max(jnp.where(active, jnp.sum(p * p, axis=1), 0.0)))
            kink = norm <= rounding * size
            phi = jnp.where(kink, jnp.maximum(softness * size, 1e-300), norm)
            y = jnp.where(kink, 0.0, r / phi)
            slope = p @ y
            hessian = hessian + (gram - jnp.outer(slope, slope)) / phi
            pull, hidden = pull + slope, hidden + jnp.where(kink, gram, 0.0)
            units, normals = [*units, y], [*normals, y]
            lengths, kinks = [*lengths, phi], [*kinks, kink]
        inverse = _pseudo_inverse(project @ hessian @ project)
        if not squared:
            # A vanished residual still pulls: the shortest such forces that balance the others.
            share = -_pseudo_inverse(project @ hidden @ project) @ (project @ pull)
            forces = [jnp.where(kink, share @ p, 0.0) for p, kink in zip(near, kinks, strict=True)]
            units = [
                y + force / jnp.maximum(1.0, jnp.linalg.norm(force))
                for y, force in zip(units, forces, strict=True)
            ]
        return jax.tree.map(
            lambda x: jax.lax.convert_element_type(x, dtype), (units, normals, lengths, inverse)
        )


def _pseudo_inverse(matrix: Array) -> Array:
    values, vectors = jnp.linalg.eigh(matrix)
    usable = values > 1e-13 * jnp.maximum(values[-1], 1e-300)
    reciprocal = jnp.where(usable, 1.0 / jnp.where(usable, values, 1.0), 0.0)
    return (vectors * reciprocal) @ vectors.T
