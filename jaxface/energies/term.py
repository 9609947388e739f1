"""Terms of an energy and their sum.

A term is a short pure function of ``(y, args)``. A *residual* term returns a pytree ``r`` of
arrays and counts as ``weight * ||r||^2`` (there is no hidden one half); a *scalar* term returns
its energy and counts as ``weight * value``.
"""

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.flatten_util import ravel_pytree

from jaxface._types import Array, Bool, Float, PyTree


class Quadratic(NamedTuple):
    """Second-order model of an energy around a point, in the flattened unknowns.

    ``E(y + d) ~ value + gradient . d + d^T curvature d``, so for ``||r||^2`` the gradient is
    ``2 J^T r`` and the curvature ``J^T J``.

    Attributes:
        value: the energy at the point.
        gradient: its derivative there.
        curvature: half its Hessian, or what stands for it.
        not_finite: of a sum, by name of the term, whether its value, gradient and curvature hold
            an entry that is not finite; a single term leaves it out.
    """

    value: Float[Array, ""]
    gradient: Float[Array, "p"]
    curvature: Float[Array, "p p"]
    not_finite: dict[str, Bool[Array, "3"]] | None = None


class Term(NamedTuple):
    """One named, weighted summand of an energy.

    Attributes:
        name: the key under which its value is reported.
        fn: ``fn(y, args)``; a pytree of residuals or a scalar, by ``kind``.
        weight: non-negative factor, or a function of ``args`` that gives it. Such a weight is data:
            a solver's answer can be differentiated with respect to it, and a sweep over its
            values runs one compiled program.
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
        """The weighted energy of this term.

        Raises:
            ValueError: the term is complex, or a scalar term gives no scalar.
        """
        out = self.output(y, args)
        if self.kind == "residual":
            out = sum_of_squares(out)
        return _times(self.weight_at(args), out)

    def output(self, y: PyTree, args: PyTree) -> Any:
        """What ``fn`` gives, unweighted.

        Raises:
            ValueError: an array of it is complex, or a scalar term gives no scalar.
        """
        out = self.fn(y, args)
        for leaf in jax.tree.leaves(out):
            if jnp.iscomplexobj(leaf):
                raise ValueError(
                    f"term {self.name!r} gives {jnp.result_type(leaf)}; it must be real: give the "
                    "real and the imaginary part as two residuals"
                )
        if self.kind == "scalar":
            shapes = [jnp.shape(leaf) for leaf in jax.tree.leaves(out)]
            if shapes != [()]:
                raise ValueError(
                    f"term {self.name!r} is scalar and gives arrays of shapes {shapes}; it must "
                    "give one number, or be of kind 'residual'"
                )
        return out

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

    def total(self, y: PyTree, args: PyTree) -> Float[Array, ""]:
        """The total energy alone, for ``jax.grad`` and for minimisers that take a plain scalar."""
        return self.value(y, args)[0]

    def residual(self, y: PyTree, args: PyTree) -> dict[str, PyTree]:
        """All residuals, each scaled by the square root of its weight, by name.

        At a weight of 0 the root has no derivative; it is then taken as 0, so that derivatives
        of the residual in a weight exist everywhere. Those of ``value`` are exact there too.

        Raises:
            ValueError: a term is scalar, so that the energy is not a sum of squares, or complex.
        """
        scalar = [term.name for term in self.terms if term.kind != "residual"]
        if scalar:
            raise ValueError(
                f"the energy is not a sum of squares: term(s) {scalar} are scalar; "
                "give them as residuals or use a general minimiser"
            )

        def scaled(term: Term) -> PyTree:
            weight = term.weight_at(args)
            none = jnp.asarray(weight == 0)  # the root of a negative weight stays NaN
            root = jnp.where(none, 0.0, jnp.sqrt(jnp.where(none, 1.0, weight)))
            return jax.tree.map(lambda r: _times(root, r), term.output(y, args))

        return {term.name: scaled(term) for term in self.terms}

    def quadratic(self, y: PyTree, args: PyTree) -> tuple[Quadratic, dict[str, Array]]:
        """The weighted sum of the terms' second-order models, and each term's weighted value."""
        parts, values, not_finite = [], {}, {}
        for term in self.terms:
            model = (term.quadratic or quadratic_by_autodiff(term))(y, args)
            weight = term.weight_at(args)
            part = [_times(weight, x) for x in (model.value, model.gradient, model.curvature)]
            parts.append(part)
            values[term.name] = part[0]
            not_finite[term.name] = jnp.stack([~jnp.all(jnp.isfinite(x)) for x in part])
        total = jax.tree.map(lambda *xs: sum(xs[1:], xs[0]), *parts)
        return Quadratic(total[0], total[1], total[2], not_finite), values


def compose(terms: Sequence[Term]) -> Energy:
    """Add terms to one energy.

    Raises:
        ValueError: no term, two terms of one name, an unknown kind, or a weight that is known
            (neither traced nor a function) and not a real number of 0 or more.
    """
    if not terms:
        raise ValueError("an energy needs at least one term")
    names = [term.name for term in terms]
    if len(set(names)) != len(names):
        raise ValueError(f"the names of the terms must differ, but they are {names}")
    for term in terms:
        if term.kind not in ("residual", "scalar"):
            raise ValueError(f"term {term.name!r} has kind {term.kind!r}, not residual or scalar")
        _check_weight(term)
    return Energy(tuple(terms))


def _times(weight: Any, x: Array) -> Array:
    """The product in the precision of ``x``, whatever that of the weight."""
    exact = jnp.issubdtype(jnp.result_type(x), jnp.floating)
    return jnp.asarray(weight, jnp.result_type(x) if exact else jnp.result_type(float)) * x


def _check_weight(term: Term) -> None:
    weight = term.weight
    if isinstance(weight, Tracer) or callable(weight):
        return
    number = np.asarray(weight)
    if number.shape != () or number.dtype.kind not in "biuf" or not number >= 0:
        raise ValueError(
            f"term {term.name!r} has weight {weight!r}; it must be one real number >= 0, or a "
            "function of args that gives it"
        )


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
                return term.output(unravel(x), args)

            value, gradient = jax.value_and_grad(energy)(flat)
            return Quadratic(value, gradient, 0.5 * jax.hessian(energy)(flat))

        def residual(x):
            r = ravel_pytree(term.output(unravel(x), args))[0]
            return r, r

        jacobian, r = jax.jacfwd(residual, has_aux=True)(flat)
        return Quadratic(jnp.sum(r * r), 2 * (r @ jacobian), jacobian.T @ jacobian)

    return model
