"""jaxface: differentiable optimisation of faces in JAX.

Names are imported when they are first asked for, so that ``import jaxface`` is quick and starts no
JAX backend; `__init__.pyi` lists them.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ += ["__version__"]
