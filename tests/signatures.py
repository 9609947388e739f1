"""How signatures are checked at run time under JAXFACE_TYPECHECK=1 (see conftest)."""

import beartype

checked = beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))
"""an int counts as a float, as PEP 484 has it"""
