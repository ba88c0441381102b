"""The filter families. Each is one module with a ``FAMILY``; this is the only list of them."""

from __future__ import annotations

from functools import cache
from importlib import import_module

from fkgen.errors import InternalError
from fkgen.families.family import Family

#: Names in the order of ``fkgen families``.
NAMES = (
    "kf",
    "mkf",
    "mme",
    "linear_optimal",
    "one_step",
    "imm",
    "genie",
    "mjls_lmmse",
    "compression_full",
    "dfcf",
    "cpcf",
)


@cache
def family(name: str) -> Family:
    """The family of this name."""
    found = import_module(f"fkgen.families.{name}").FAMILY
    if not isinstance(found, Family) or found.name != name:
        raise InternalError(f"module of family {name!r} has no FAMILY of this name")
    return found
