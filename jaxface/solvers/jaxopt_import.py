"""jaxopt, imported where it is used. It is no longer developed, and says so on import."""

import importlib
import warnings
from types import ModuleType

NOTICE = "JAXopt is no longer maintained"
"""how the warning begins that is silenced, and no other"""


def jaxopt() -> ModuleType:
    """The module, without its notice.

    Raises:
        ImportError: jaxopt is missing, or no longer works with the installed JAX.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", NOTICE, DeprecationWarning)
        try:
            return importlib.import_module("jaxopt")
        except Exception as error:
            raise ImportError(
                "the methods of jaxopt need a jaxopt that works with the installed JAX "
                f"({error}); use another method"
            ) from error
