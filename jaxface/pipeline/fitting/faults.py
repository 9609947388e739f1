"""A fit that did not stay finite, told by the term that is to blame."""

import jax
import numpy as np

from jaxface.pipeline.fitting.fitted_face import FittedFace


def check_finite(fitted: FittedFace) -> None:
    """Refuse a fit one of whose terms was not finite, at any step of any level.

    The solver takes no step that it cannot compare, so that such a fit is a start given back.

    Raises:
        ValueError: a term, its derivative or an unknown is not finite; the message names it.
    """
    told = "check the photo, the model and your own terms for NaN and division by zero"
    for history, used in zip(fitted.stats.energies, fitted.stats.steps, strict=True):
        # Without a step nothing was evaluated.
        entries = int(used) + 1 if int(used) else 0
        bad = [n for n, v in history.items() if not np.isfinite(np.asarray(v)[:entries]).all()]
        named = [name for name in bad if name != "total"] or bad
        if named:
            raise ValueError(f"the energy of the term(s) {named} is not finite; {told}")
    leaves = jax.tree.leaves(fitted.parameters)
    finite = all(np.isfinite(np.asarray(x)).all() for x in leaves)
    if not (finite and np.isfinite(np.asarray(fitted.stats.curvature)).all()):
        raise ValueError(
            f"the fit did not stay finite: a derivative of the term(s) {_steep(fitted)} is not; "
            f"{told}"
        )


def _steep(fitted: FittedFace) -> list[str]:
    """The terms with a derivative that is not finite at the answer."""
    energy, y, data = fitted.problem()
    found = []
    for term in energy.terms:
        slope = jax.grad(term.value)(y, data)
        if not all(np.isfinite(np.asarray(x)).all() for x in jax.tree.leaves(slope)):
            found.append(term.name)
    return found
