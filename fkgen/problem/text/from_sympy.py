"""SymPy expressions and matrices, walked into expression trees."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from fkgen.problem.table.place import Place, show
from fkgen.problem.text.expression import (
    MAX_NODES,
    Expression,
    Name,
    Number,
    operation,
    product,
    total,
)

_FUNCTIONS = {
    "exp": "exp",
    "log": "log",
    "sin": "sin",
    "cos": "cos",
    "tan": "tan",
    "atan2": "atan2",
    "Abs": "abs",
}
_SUPPORTED = "numbers, symbols, + - * / **, exp, log, sqrt, sin, cos, tan, atan2, Abs, pi and E"


def sympy_rows(value: Any, place: Place) -> object:
    """Return the rows of a SymPy matrix; anything else as `sympy_expression` does."""
    sympy = import_module("sympy")
    if not isinstance(value, sympy.MatrixBase):
        return sympy_expression(value, place)
    return [
        [
            _Walk(sympy, place.item(i, j), value[i, j]).convert(value[i, j])
            for j in range(value.shape[1])
        ]
        for i in range(value.shape[0])
    ]


def sympy_expression(value: Any, place: Place) -> object:
    """Return a SymPy scalar as an expression (a number as a float), a matrix as it is."""
    sympy = import_module("sympy")
    if isinstance(value, sympy.MatrixBase):
        return value
    expression = _Walk(sympy, place, value).convert(value)
    return expression.value if isinstance(expression, Number) else expression


class _Walk:
    """Converts one SymPy expression, node by node."""

    def __init__(self, sympy: Any, place: Place, whole: object) -> None:
        self.sympy, self.place, self.whole = sympy, place, whole
        self.left = MAX_NODES

    def convert(self, node: Any) -> Expression:
        sympy = self.sympy
        self.left -= 1
        if self.left < 0:
            raise self.error(f"an expression of at most {MAX_NODES} terms and factors")
        if isinstance(node, sympy.Symbol):
            return Name(str(node.name))
        if isinstance(node, sympy.Rational | sympy.Float) or node in {sympy.pi, sympy.E}:
            return self.number(node)
        try:
            return self.compound(node)
        except ArithmeticError as fault:
            raise self.error(f"a finite real value, but {fault}") from None
        except RecursionError:
            raise self.error("an expression that is nested less deeply") from None

    def number(self, node: Any) -> Expression:
        try:
            return Number(_finite(float(node)))
        except (OverflowError, ArithmeticError):
            raise self.error("numbers that fit a double") from None

    def compound(self, node: Any) -> Expression:
        sympy = self.sympy
        if isinstance(node, sympy.Add):
            return total([self.convert(term) for term in node.args])
        if isinstance(node, sympy.Mul):
            return self.quotient(node)
        if isinstance(node, sympy.Pow):
            return self.power(node.base, node.exp)
        kind = type(node).__name__
        if kind in _FUNCTIONS and isinstance(node, sympy.Function):
            return operation(_FUNCTIONS[kind], *(self.convert(argument) for argument in node.args))
        raise self.error(f"{_SUPPORTED}, without {kind}")

    def quotient(self, node: Any) -> Expression:
        sympy = self.sympy
        above: list[Expression] = []
        below: list[Expression] = []
        negative = False
        for factor in node.args:
            if factor == -1:
                negative = True
            elif isinstance(factor, sympy.Pow) and factor.exp.is_Rational and factor.exp < 0:
                below.append(self.power(factor.base, -factor.exp))
            else:
                above.append(self.convert(factor))
        result = product(above)
        if below:
            result = operation("/", result, product(below))
        return operation("neg", result) if negative else result

    def power(self, base: Any, exponent: Any) -> Expression:
        sympy = self.sympy
        if base == sympy.E:
            return operation("exp", self.convert(exponent))
        if exponent.is_Rational and exponent < 0:
            return operation("/", Number(1.0), self.power(base, -exponent))
        if exponent == 1:
            return self.convert(base)
        if exponent == sympy.Rational(1, 2):
            return operation("sqrt", self.convert(base))
        return operation("**", self.convert(base), self.convert(exponent))

    def error(self, expected: str) -> Exception:
        return self.place.error(show(self.whole), expected)


def _finite(value: float) -> float:
    if value - value != 0.0:
        raise ArithmeticError
    return value
