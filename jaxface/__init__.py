"""jaxface: differentiable optimisation of faces in JAX.

The names below are imported when they are first asked for, so that ``import jaxface`` is quick
and starts no JAX backend.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxface.energies.term import Term, compose
    from jaxface.io.models import load_model
    from jaxface.pipeline import digitize, fit, save_fit, texture
    from jaxface.stages.fit import FitWeights
    from jaxface.stages.landmarks import detect_faces

__version__ = "0.1.0"

__all__ = [
    "FitWeights",
    "Term",
    "__version__",
    "compose",
    "detect_faces",
    "digitize",
    "fit",
    "load_model",
    "save_fit",
    "texture",
]

_HOME = {
    "FitWeights": "jaxface.stages.fit",
    "Term": "jaxface.energies.term",
    "compose": "jaxface.energies.term",
    "detect_faces": "jaxface.stages.landmarks",
    "digitize": "jaxface.pipeline",
    "fit": "jaxface.pipeline",
    "load_model": "jaxface.io.models",
    "save_fit": "jaxface.pipeline",
    "texture": "jaxface.pipeline",
}


def __getattr__(name: str) -> Any:
    """Import a public name on its first use (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
