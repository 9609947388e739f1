"""Newton's method on the face of the simplex that an approximate solution has found.

Where the residual of a term vanishes at the solution, an interior point method computes its dual
vector as a quotient of rounding errors. Here such a term is a constraint, and its dual vector a
multiplier that is corrected step by step (the method of multipliers: Hestenes, "Multiplier and
gradient methods", J. Optim. Theory Appl. 4, 1969).
"""

import jax
import jax.numpy as jnp

from jaxface._types import Array, Float

SIZE = 256
"""most weights that are polished"""
SOFTNESS = 1e-5
"""length by which a multiplier of unit length gives way, of points of order one"""


def polish(
    points: Float[Array, "k l m"],
    weights: Float[Array, " k"],
    dual: Float[Array, "l m"],
    *,
    present: float = 1e-7,
    vanished: float = 1e-7,
    steps: int = 6,
) -> tuple[Float[Array, " k"], Float[Array, "l m"]]:
    """Weights and dual vectors nearer to the solution, if the face is right; else anything.

    Args:
        points: of order one.
        weights: approximate solution.
        dual: approximate dual vectors; those of vanished terms are improved on.
        present: weights above this share of the largest are changed, the others become zero.
        vanished: terms with a smaller residual are held at zero.
        steps: Newton steps.
    """
    w, chosen = jax.lax.top_k(weights, min(SIZE, len(weights)))
    active = w > present * w[0]
    ones = active.astype(w.dtype)
    near = (points[chosen] * ones[:, None, None]).transpose(1, 0, 2)  # (l, s, m)
    grams = near @ near.transpose(0, 2, 1)
    index = jax.lax.iota(jnp.int32, len(w))
    eye = (index[:, None] == index).astype(w.dtype)
    w = w * ones / jnp.sum(w * ones)
    zero = jnp.linalg.norm(jnp.einsum("lsm,s->lm", near, w), axis=-1) <= vanished

    def step(_: int, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        w, y = carry
        r = jnp.einsum("lsm,s->lm", near, w)
        norms = jnp.linalg.norm(r, axis=-1)
        phi = jnp.where(zero, SOFTNESS, jnp.maximum(norms, SOFTNESS))
        unit = jnp.where(zero[:, None], 0.0, r / phi[:, None])
        pull = jnp.where(zero[:, None], y + r / SOFTNESS, unit)
        slopes = jnp.einsum("lsm,lm->sl", near, unit)
        hessian = jnp.tensordot(1.0 / phi, grams, 1) - (slopes / phi) @ slopes.T
        mean = jnp.sum(hessian * eye) / jnp.sum(ones)
        hessian = hessian + mean * (ones[:, None] * ones) + eye * (1e-13 * mean)
        hessian = hessian + eye * (1.0 - ones) * mean
        sides = jnp.stack([-jnp.einsum("lsm,lm->s", near, pull), ones], axis=1)
        solved = jnp.linalg.solve(hessian, sides)
        excess = jnp.sum(w) - 1.0 + jnp.sum(solved[:, 0])
        dw = (solved[:, 0] - excess / jnp.sum(solved[:, 1]) * solved[:, 1]) * ones
        y = jnp.where(zero[:, None], pull + jnp.einsum("lsm,s->lm", near, dw) / SOFTNESS, unit)
        return w + dw, y

    w, y = jax.lax.fori_loop(0, steps, step, (w, dual))
    usable = jnp.all(jnp.isfinite(w)) & jnp.all(jnp.isfinite(y))
    w = jnp.maximum(w, 0.0)
    w = jnp.zeros_like(weights).at[chosen].set(w / jnp.sum(w), unique_indices=True)
    return jnp.where(usable, w, weights), jnp.where(usable, y, dual)
