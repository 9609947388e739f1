"""Terms of an energy and their sum.

A term is a short pure function of ``(y, args)``. A *residual* term returns a pytree ``r`` of
arrays and counts as ``weight * ||r||^2`` (there is no hidden one half); a *scalar* term returns
its energy and counts as ``weight * value``.
"""

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from jaxface._numerics import safe_sqrt
from jaxface._types import Array, Float, PyTree


class Quadratic(NamedTuple):
    """Second-order model of an energy around a point, in the flattened unknowns.

    ``E(y + d) ~ value + gradient . d + d^T curvature d``, so for ``||r||^2`` the gradient is
    ``2 J^T r`` and the curvature ``J^T J``.
    """

    value: Float[Array, ""]
    gradient: Float[Array, "p"]
    curvature: Float[Array, "p p"]


class Term(NamedTuple):
    """One named, weighted summand of an energy.

    Attributes:
        name: the key under which its value is reported.
        fn: ``fn(y, args)``; a pytree of residuals or a scalar, by ``kind``.
        weight: non-negative factor, or a function of ``args`` that gives it, so that a solver's
            answer can be differentiated with respect to it.
        kind: ``"residual"`` or ``"scalar"``.
        quadratic: an optional faster ``(y, args) -> Quadratic`` of the *unweighted* term, used
            instead of automatic differentiation by Gauss-Newton solvers.
    """

    name: str
    fn: Callable[[Any, Any], Any]
    weight: float | Float[Array, ""] | Callable[[Any], Any] = 1.0
    kind: Literal["residual", "scalar"] = "residual"
    quadratic: Callable[[Any, Any], Quadratic] | None = None

    def value(self, y: PyTree, args: PyTree) -> Float[Array, ""]:
        """The weighted energy of this term."""
        out = self.fn(y, args)
        if self.kind == "residual":
            out = sum_of_squares(out)
        return self.weight_at(args) * out

    def weight_at(self, args: PyTree) -> Any:
        """The weight, for a problem's data."""
        return self.weight(args) if callable(self.weight) else self.weight


class Energy(NamedTuple):
    """A sum of terms; ``compose`` makes it."""

    terms: tuple[Term, ...]

    @property
    def is_least_squares(self) -> bool:
        """True if every term is a residual, so that ``residual`` exists."""
        return all(term.kind == "residual" for term in self.terms)

    def value(self, y: PyTree, args: PyTree) -> tuple[Float[Array, ""], dict[str, Array]]:
        """Total energy and each term's weighted value by name."""
        values = {term.name: term.value(y, args) for term in self.terms}
        return jnp.sum(jnp.stack(list(values.values()))), values

    def residual(self, y: PyTree, args: PyTree) -> dict[str, PyTree]:
        """All residuals, each scaled by the square root of its weight, by name.

        Raises:
            ValueError: a term is scalar, so that the energy is not a sum of squares.
        """
        scalar = [term.name for term in self.terms if term.kind != "residual"]
        if scalar:
            raise ValueError(
                f"the energy is not a sum of squares: term(s) {scalar} are scalar; "
                "give them as residuals or use a general minimiser"
            )

        def scaled(term: Term) -> PyTree:
            weight = term.weight_at(args)
            return jax.tree.map(
                lambda r: safe_sqrt(jnp.asarray(weight, r.dtype)) * r, term.fn(y, args)
            )

        return {term.name: scaled(term) for term in self.terms}

    def quadratic(self, y: PyTree, args: PyTree) -> tuple[Quadratic, dict[str, Array]]:
        """The weighted sum of the terms' second-order models, and each term's weighted value."""
        parts, values = [], {}
        for term in self.terms:
            model = term.quadratic or quadratic_by_autodiff(term)
            weight = term.weight_at(args)
            part = jax.tree.map(lambda x, w=weight: w * x, model(y, args))
            parts.append(part)
            values[term.name] = part.value
        return jax.tree.map(lambda *xs: sum(xs[1:], xs[0]), *parts), values


def compose(terms: Sequence[Term]) -> Energy:
    """Add terms to one energy.

    Raises:
        ValueError: no term, two terms of one name, an unknown kind, or a negative weight.
    """
    if not terms:
        raise ValueError("an energy needs at least one term")
    names = [term.name for term in terms]
    if len(set(names)) != len(names):
        raise ValueError(f"the names of the terms must differ, but they are {names}")
    for term in terms:
        if term.kind not in ("residual", "scalar"):
            raise ValueError(f"term {term.name!r} has kind {term.kind!r}, not residual or scalar")
        if isinstance(term.weight, int | float) and not term.weight >= 0:
            raise ValueError(f"term {term.name!r} has weight {term.weight}, which is not >= 0")
    return Energy(tuple(terms))


def sum_of_squares(tree: PyTree) -> Float[Array, ""]:
    """Sum of the squared entries of all leaves."""
    return jnp.sum(jnp.stack([jnp.sum(jnp.square(leaf)) for leaf in jax.tree.leaves(tree)]))


def quadratic_by_autodiff(term: Term) -> Callable[[PyTree, PyTree], Quadratic]:
    """Second-order model of a term by automatic differentiation.

    Gauss-Newton for residuals (forward mode); half the exact Hessian for scalars, which may be
    indefinite: a solver has to damp it.
    """

    def model(y: PyTree, args: PyTree) -> Quadratic:
        flat, unravel = ravel_pytree(y)
        if term.kind == "scalar":

            def energy(x):
                return term.fn(unravel(x), args)

            value, gradient = jax.value_and_grad(energy)(flat)
            return Quadratic(value, gradient, 0.5 * jax.hessian(energy)(flat))

        def residual(x):
            r = ravel_pytree(term.fn(unravel(x), args))[0]
            return r, r

        jacobian, r = jax.jacfwd(residual, has_aux=True)(flat)
        return Quadratic(jnp.sum(r * r), 2 * (r @ jacobian), jacobian.T @ jacobian)

    return model
