"""CasADi SX and DM matrices, walked into expression trees."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from fkgen.problem.table.place import Place, describe
from fkgen.problem.text.expression import (
    MAX_DEPTH,
    MAX_NODES,
    ONE,
    ZERO,
    Expression,
    Name,
    Number,
    depth,
    operation,
    size,
)

_OPERATIONS = {
    "OP_ADD": "+",
    "OP_SUB": "-",
    "OP_MUL": "*",
    "OP_DIV": "/",
    "OP_NEG": "neg",
    "OP_POW": "**",
    "OP_CONSTPOW": "**",
    "OP_EXP": "exp",
    "OP_LOG": "log",
    "OP_SQRT": "sqrt",
    "OP_SIN": "sin",
    "OP_COS": "cos",
    "OP_TAN": "tan",
    "OP_ATAN2": "atan2",
    "OP_FABS": "abs",
}
_SUPPORTED = "+ - * / **, exp, log, sqrt, sin, cos, tan, atan2 and fabs"


def casadi_rows(value: Any, place: Place) -> list[list[float]] | list[list[Expression]]:
    """Return the rows of a CasADi SX (expressions) or DM matrix (numbers)."""
    casadi = import_module("casadi")
    if isinstance(value, casadi.DM):
        numbers: list[list[float]] = value.full().tolist()
        return numbers
    if not isinstance(value, casadi.SX):
        raise place.error(describe(value), "a CasADi SX or DM matrix")
    return _Walk(casadi, place, casadi.densify(value)).rows()


class _Walk:
    """Converts one SX matrix by the instructions of the function that computes it."""

    def __init__(self, casadi: Any, place: Place, value: Any) -> None:
        self.casadi, self.place, self.value = casadi, place, value
        self.names = {getattr(casadi, key): key for key in dir(casadi) if key.startswith("OP_")}

    def rows(self) -> list[list[Expression]]:
        casadi = self.casadi
        symbols = casadi.symvar(self.value)
        function = casadi.Function("entries", symbols, [self.value])
        row_count, column_count = self.value.shape
        entries: list[list[Expression]] = [[ZERO] * column_count for _ in range(row_count)]
        work: dict[int, Expression] = {}
        for k in range(function.n_instructions()):
            kind = self.names[function.instruction_id(k)]
            inputs, outputs = function.instruction_input(k), function.instruction_output(k)
            if kind == "OP_INPUT":
                work[outputs[0]] = Name(str(symbols[inputs[0]].name()))
            elif kind == "OP_CONST":
                work[outputs[0]] = self.constant(function.instruction_constant(k))
            elif kind == "OP_OUTPUT":
                column, row = divmod(outputs[1], row_count)
                entries[row][column] = work[inputs[0]]
            else:
                work[outputs[0]] = self.operate(kind, [work[index] for index in inputs])
        return entries

    def constant(self, value: float) -> Expression:
        if value - value != 0.0:
            raise self.place.error(f"an entry {value}", "finite numbers")
        return Number(value)

    def operate(self, kind: str, arguments: list[Expression]) -> Expression:
        try:
            result = self.combine(kind, arguments)
        except ArithmeticError as fault:
            raise self.place.error("a CasADi matrix", f"finite real values, but {fault}") from None
        if depth(result) > MAX_DEPTH or size(result) > MAX_NODES:
            raise self.place.error(
                "a CasADi matrix",
                f"entries of at most {MAX_NODES} operations when written out, "
                f"nested at most {MAX_DEPTH} deep",
            )
        return result

    def combine(self, kind: str, arguments: list[Expression]) -> Expression:
        first = arguments[0]
        if kind in _OPERATIONS:
            return operation(_OPERATIONS[kind], *arguments)
        if kind == "OP_SQ":
            return operation("**", first, Number(2.0))
        if kind == "OP_TWICE":
            return operation("*", Number(2.0), first)
        if kind == "OP_INV":
            return operation("/", ONE, first)
        name = kind.removeprefix("OP_").lower()
        raise self.place.error(f"a CasADi matrix that uses {name}", f"only {_SUPPORTED}")
