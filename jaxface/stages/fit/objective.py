"""Equation 1 of Saito 2017 as a sum of terms, over all unknowns or over those that are free."""

import dataclasses
import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax

from jaxface._numerics import safe_sqrt
from jaxface._types import Array, Float
from jaxface.energies._photometric_quadratic import photometric_quadratic
from jaxface.energies.landmark import landmark_residual
from jaxface.energies.photometric import photometric_energy, photometric_root_residual
from jaxface.energies.prior import focal_residual, light_residual, prior_residual
from jaxface.energies.term import Energy, Quadratic, Term, compose
from jaxface.models.parameters import FaceParameters, free_columns, put_together
from jaxface.stages.fit.records import FitData, FitWeights


def fit_energy(
    weights: FitWeights | None = None,
    extra_terms: Sequence[Term] = (),
    freeze: tuple[str, ...] = (),
    *,
    least_squares: bool = False,
) -> Energy:
    """Equation 1 of Saito 2017 as composed terms of ``(FaceParameters, FitData)``.

    Args:
        weights: of the terms; by default those in the data, with respect to which a fit can then
            be differentiated.
        extra_terms: your own.
        freeze: fields of ``FaceParameters`` that are no unknowns: they are None in ``y``, and the
            terms see ``held`` of the data in their place.
        least_squares: the photo term as a residual too (``photometric_root_residual``), for
            least-squares solvers; its value is the same but for differences of colour under 1e-3.
    """
    if least_squares:
        photo = Term("photo", _photo_residual, _weight(weights, "photo"))
    else:
        photo = Term("photo", _photo_value, _weight(weights, "photo"), "scalar", _photo_quadratic)
    light = Term("light", lambda y, d: light_residual(y), _weight(weights, "light"))
    terms = [photo, *_geometric_terms(weights), light, *extra_terms]
    return compose([_over_free(term, freeze) for term in terms])


def geometric_energy(freeze: tuple[str, ...] = ()) -> Energy:
    """Landmarks and priors on the geometry alone, with the weights in the data."""
    return compose([_over_free(term, freeze) for term in _geometric_terms()])


class ExtraWeight(NamedTuple):
    """The weight of a term of the caller's own, looked up in the data by its name."""

    name: str

    def __call__(self, data: FitData) -> float | Array:
        """The weight."""
        return data.weights.extra[self.name]


def weights_as_data(
    weights: FitWeights, extra_terms: Sequence[Term]
) -> tuple[FitWeights, tuple[Term, ...]]:
    """Extra terms whose weights are data, so that another weight needs no other program.

    Args:
        weights: of the built-in terms; weights in its ``extra`` stand over the terms' own.
        extra_terms: a weight that is a function of the data stays.

    Raises:
        ValueError: ``extra`` names a term that there is not.
    """
    given = {term.name: term.weight for term in extra_terms if not callable(term.weight)}
    unknown = sorted(set(weights.extra) - set(given))
    if unknown:
        raise ValueError(
            f"weights.extra names {unknown}; the extra terms with a weight are {sorted(given)}"
        )
    both = dataclasses.replace(weights, extra={**given, **weights.extra})
    terms = tuple(
        term._replace(weight=ExtraWeight(term.name)) if term.name in given else term
        for term in extra_terms
    )
    return both, terms


def _weight(weights: FitWeights | None, name: str) -> Any:
    return operator.attrgetter(f"weights.{name}") if weights is None else getattr(weights, name)


def _photo_value(y: FaceParameters, data: FitData) -> Float[Array, ""]:
    return data.photo_trust * photometric_energy(y, data.photo)


def _photo_residual(y: FaceParameters, data: FitData) -> Float[Array, "p 3"]:
    return safe_sqrt(data.photo_trust) * photometric_root_residual(y, data.photo)


def _photo_quadratic(y: FaceParameters, data: FitData) -> Quadratic:
    model = photometric_quadratic(y, data.photo, data.normal_modes, data.curvature_samples)
    return jax.tree.map(lambda x: data.photo_trust * x, model)


def _geometric_terms(weights: FitWeights | None = None) -> list[Term]:
    def landmark(y: FaceParameters, d: FitData) -> Array:
        return safe_sqrt(d.landmark_trust) * landmark_residual(y, d.landmark)

    def focal(y: FaceParameters, d: FitData) -> Array:
        return focal_residual(y, d.focal_prior)

    return [
        Term("landmark", landmark, _weight(weights, "landmark")),
        Term("prior", lambda y, d: prior_residual(y), _weight(weights, "prior")),
        Term("focal", focal, _weight(weights, "focal")),
    ]


def _over_free(term: Term, freeze: tuple[str, ...]) -> Term:
    """The term as a function of the free unknowns, the others taken from the data."""
    if not freeze:
        return term

    def value(free: FaceParameters, data: FitData) -> Any:
        return term.fn(put_together(free, data.held), data)

    quadratic = None if term.quadratic is None else _free_part(term.quadratic, freeze)
    return term._replace(fn=value, quadratic=quadratic)


def _free_part(
    whole: Callable[[Any, Any], Quadratic], freeze: tuple[str, ...]
) -> Callable[[Any, Any], Quadratic]:
    def quadratic(free: FaceParameters, data: FitData) -> Quadratic:
        y = put_together(free, data.held)
        model, kept = whole(y, data), free_columns(y, freeze)
        return Quadratic(model.value, model.gradient[kept], model.curvature[kept[:, None], kept])

    return quadratic
