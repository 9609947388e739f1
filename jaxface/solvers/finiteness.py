"""What was not finite where a solve stopped: flags that survive jit and vmap, and their words."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Bool, PyTree

QUANTITIES = ("value", "gradient", "curvature")
"""what the three flags of a term are about; of a least-squares residual the second is the
Jacobian"""

TOTAL = "total"
"""name of the flags of the whole energy"""

NotFinite = dict[str, Bool[Array, "3"]]
"""by name of a term: whether its value, gradient and curvature held an entry that was not finite"""


class NotFiniteError(ValueError):
    """A solve met a NaN or an infinite number; the message names the term and the quantity."""


def holds_no_number(*trees: PyTree) -> Bool[Array, ""]:
    """Whether any floating-point entry of any of the trees is not finite."""
    leaves = [x for tree in trees for x in _floating(tree)]
    return jnp.any(jnp.stack([jnp.asarray(False), *[~jnp.all(jnp.isfinite(x)) for x in leaves]]))


def flags(value: Any = False, gradient: Any = False, curvature: Any = False) -> Bool[Array, "3"]:
    """The three flags of a term."""
    return jnp.stack([jnp.asarray(x, bool) for x in (value, gradient, curvature)])


def not_finite_words(not_finite: Mapping[str, Bool[Array, "*batch 3"]]) -> str:
    """``"the value and the gradient of 'photo'; the value of 'mine'"``; empty if all was finite.

    The whole energy is left out where a term of it is to blame.

    Args:
        not_finite: concrete flags, ``Solution.stats["not_finite"]``; a batch's are joined.
    """
    raised = {
        name: np.asarray(flag).reshape(-1, len(QUANTITIES)).max(axis=0)
        for name, flag in not_finite.items()
    }
    guilty = {name: flag for name, flag in raised.items() if flag.any()}
    if len(guilty) > 1:
        guilty.pop(TOTAL, None)
    said = []
    for name, flag in guilty.items():
        what = " and ".join(f"the {q}" for q, bad in zip(QUANTITIES, flag, strict=True) if bad)
        said.append(f"{what} of {'the energy' if name == TOTAL else repr(name)}")
    return "; ".join(said)


def require_finite(not_finite: Mapping[str, Bool[Array, "*batch 3"]], what: str) -> None:
    """Raise if a solve met numbers that are not finite.

    Args:
        not_finite: concrete flags, ``Solution.stats["not_finite"]``.
        what: what the message calls the solve, for instance ``"the fit"``.

    Raises:
        NotFiniteError: a flag is raised; the message names the terms and the quantities.
    """
    words = not_finite_words(not_finite)
    if words:
        raise NotFiniteError(f"{what} met numbers that are not finite (NaN or infinite): {words}")


def _floating(tree: PyTree) -> list[Array]:

    arrays = [jnp.asarray(x) for x in jax.tree.leaves(tree)]
    return [x for x in arrays if jnp.issubdtype(x.dtype, jnp.inexact)]
