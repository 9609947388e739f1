"""Many targets over the same points: products of the points once, certificates all together.

`simplex_faces` finds the weights of one target after another from products; these are squares, and
lose half the digits of a small residual. Newton steps on the face that was found, with residuals
and prices from the points themselves, bring them back. What those do not bring within the
tolerance is left to the method of a single target.
"""

from functools import partial

import jax
import jax.numpy as jnp

from jaxface._numerics import safe_normalize
from jaxface._types import Array, Float
from jaxface.solvers.simplex._working_set import Found, cleaned, closed
from jaxface.solvers.simplex.answer import ZERO, Answer, Norm, rounded
from jaxface.solvers.simplex.certificate import Certificate
from jaxface.solvers.simplex.faces import SLOTS, Products, newton_direction, newton_on_faces

FEWEST = 8
"""targets that are worth the products of the points"""
REFINEMENTS = 3
PRESENT = 1e-9
"""weights above this share of the largest are changed by a refinement"""


def pays(targets: int, points: int) -> bool:
    """Whether there are targets enough, and points for the faces that are sought."""
    return targets >= FEWEST and points >= 4 * SLOTS


@partial(jax.jit, static_argnums=(0, 1))
def solve_many(
    norm: Norm,
    dtype: str,
    points: Float[Array, "k l m"],
    targets: Float[Array, "t l m"],
    starts: Float[Array, "t k"],
    tolerance: Float[Array, ""],
) -> Answer:
    """`solve` by ``working_set`` for many targets; all fields get a leading axis. In doubles."""
    middle = jnp.mean(points, axis=0)
    around, moved = points - middle, targets - middle
    if norm == "squared":
        around, moved = around.reshape(len(points), 1, -1), moved.reshape(len(targets), 1, -1)
    size = jnp.max(jnp.sum(jnp.linalg.norm(around, axis=-1), axis=-1))
    size = jnp.where(size > 0, size, 1.0)
    around, moved = around / size, moved / size
    found = many_targets(around, moved, starts, tolerance, jnp.asarray(ZERO, jnp.float64))

    def answer(target: Array, origin: Array, found: Found) -> Answer:
        return rounded(around, size, target, found, tolerance, origin, norm=norm, dtype=dtype)

    inner = jnp.einsum("klm,tlm->tkl", around, moved)
    own = jnp.sum(around**2, axis=-1) - 2.0 * inner + jnp.sum(moved**2, axis=-1)[:, None]
    scale = size * jnp.max(jnp.sum(jnp.sqrt(jnp.maximum(own, 0.0)), axis=-1), axis=-1)
    scale = (scale if norm == "frobenius" else scale**2).astype(dtype)
    return jax.vmap(answer)(targets, moved, found)._replace(scale=scale)


def many_targets(
    points: Float[Array, "k l m"],
    targets: Float[Array, "t l m"],
    starts: Float[Array, "t k"],
    tolerance: Float[Array, ""],
    floor: Float[Array, ""],
) -> Found:
    """Minimise ``sum_l ||sum_k w_k p_kl - t_l||`` over the simplex for each target.

    Args:
        points: of order one, around the origin.
        targets: in the same space.
        starts: weights to start from.
        tolerance: stop at this gap, relative to the objective.
        floor: an objective that counts as zero.

    Returns:
        All fields have a leading axis of targets.
    """
    layers = points.transpose(1, 0, 2)
    grams = layers @ layers.transpose(0, 2, 1)
    inner = jnp.einsum("lkm,tlm->tlk", layers, targets)
    squares = jnp.sum(targets**2, axis=-1)

    def on_faces(data: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        return newton_on_faces(Products(grams, data[0], data[1]), data[2], tolerance)

    weights, steps = jax.lax.map(on_faces, (inner, squares, starts))
    weights = jax.vmap(cleaned)(weights)
    found = _evaluated(layers, targets, weights)
    for _ in range(REFINEMENTS):
        refined = partial(_refined, grams)
        weights = jax.vmap(refined)(inner, squares, found[0], found[1].norms, found[2])
        found = _better(found, _evaluated(layers, targets, weights))
    weights, certificate, _ = found
    rounds = jnp.ones_like(steps)
    converged = jax.vmap(closed, (0, None, None))(certificate, tolerance, floor)
    return Found(weights, certificate, rounds, steps, converged)


def better(one: Answer, other: Answer) -> Answer:
    """Of two answers to one target that with the smaller gap, and the effort of both."""
    first = one.gap <= other.gap
    chosen = jax.tree.map(lambda a, b: jnp.where(first, a, b), one, other)
    return chosen._replace(rounds=one.rounds + other.rounds, steps=one.steps + other.steps)


def _evaluated(layers: Array, targets: Array, weights: Array) -> tuple[Array, Certificate, Array]:
    """Weights, their certificates, and the prices by term (t, l, k)."""
    r = jnp.einsum("tk,lkm->tlm", weights, layers) - targets
    norms = jnp.linalg.norm(r, axis=-1)
    dual = safe_normalize(r)
    parts = jnp.einsum("tlm,lkm->tlk", dual, layers) - jnp.sum(dual * targets, axis=-1)[..., None]
    prices = jnp.sum(parts, axis=1)
    bound = jnp.maximum(jnp.min(prices, axis=1), 0.0)
    return weights, Certificate(jnp.sum(norms, axis=1), bound, norms, prices, dual), parts


def _better(
    old: tuple[Array, Certificate, Array], new: tuple[Array, Certificate, Array]
) -> tuple[Array, Certificate, Array]:
    """By target, the one with the smaller gap."""
    gaps = [c.objective - c.bound for _, c, _ in (old, new)]
    better = gaps[1] < gaps[0]

    def choose(a: Array, b: Array) -> Array:
        return jnp.where(better.reshape(-1, *(1,) * (a.ndim - 1)), b, a)

    return jax.tree.map(choose, old, new)


def _refined(
    grams: Array, inner: Array, squares: Array, weights: Array, norms: Array, parts: Array
) -> Array:
    """A Newton step on the face of positive weights, with exact slopes ``parts`` (l, k)."""
    w, chosen = jax.lax.top_k(weights, SLOTS)
    used = w > PRESENT * w[0]
    inside = inner[:, chosen]
    near = grams[:, chosen[:, None], chosen] - inside[:, :, None] - inside[:, None, :]
    near = (near + squares[:, None, None]) * (used[:, None] & used)
    slopes = parts[:, chosen] * used
    safe = jnp.where(norms > 0, norms, 1.0)
    hessian = jnp.tensordot(1.0 / safe, near, 1)
    if len(grams) > 1:
        unit = slopes / jnp.sqrt(safe)[:, None]
        hessian = hessian - unit.T @ unit
    new = w * used + newton_direction(hessian, jnp.sum(slopes, axis=0), used)
    new = jnp.maximum(new, 0.0)
    whole = jnp.zeros_like(weights).at[chosen].set(new / jnp.sum(new), unique_indices=True)
    return jnp.where(jnp.all(jnp.isfinite(whole)), whole, weights)
