"""Energies: short pure functions of ``(y, args)``, and the terms that weigh and add them.

Names are imported when they are first asked for; `__init__.pyi` lists them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
