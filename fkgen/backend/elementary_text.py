"""What the template of the elementary functions reads."""

from __future__ import annotations

import math

from fkgen.backend.elementary import FORMATS
from fkgen.backend.ir import Operator, Scalar
from fkgen.backend.printer import StatementPrinter, shared_prefix

#: Name of the files that hold the functions for all filters of a program, by scalar.
SHARED = "fkgen_elementary_{}"


def shared_context(scalar: Scalar) -> dict[str, object]:
    """What the templates of the shared files read: every function, whatever a filter needs."""
    c = StatementPrinter(shared_prefix(scalar), scalar, 1)
    functions = frozenset(operator for operator in Operator if operator.is_function)
    return elementary_context(c, functions) | {"storage": "", "file": SHARED.format(scalar)}


def elementary_context(c: StatementPrinter, functions: frozenset[Operator]) -> dict[str, object]:
    """Names, constants, and which functions there are; sqrt where atan2 needs it."""
    needs = {op.value: op in functions for op in Operator if op.is_function}
    needs["wave"] = needs["sin"] or needs["cos"] or needs["tan"]
    needs["scale"] = needs["exp"]
    needs["sqrt"] = needs["sqrt"] or needs["atan2"]
    return {
        "c": c,
        "name": c.name,
        "elementary": c.elementary,
        "storage": "static ",
        "upper": c.upper,
        "real": c.real,
        "word": "uint64_t" if c.real == "double" else "uint32_t",
        "f": FORMATS[c.real],
        "needs": needs,
        "needs_elementary": bool(functions),
        "shared": SHARED.format(c.real) if functions and c.elementary != c.name else "",
        "root2": math.sqrt(2.0),
        "ln2": math.log(2.0),
        "pi": math.pi,
    }
