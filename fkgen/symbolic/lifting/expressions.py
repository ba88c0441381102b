"""Expressions and matrices of a spec as CasADi: zeros stay structural, constants constants."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping

import casadi as ca

from fkgen.errors import InternalError
from fkgen.problem import Expression, Matrix, Name, Number, Operation, Spec
from fkgen.problem.text.discretise import OF_TIME, Continuous
from fkgen.problem.text.expression import COMPARISONS, FUNCTIONS, Computed
from fkgen.problem.text.lookup import Table
from fkgen.symbolic.lifting.discretise import discretised, doublings


class Wholes:
    """Matrices that are computed as a whole, each once, and what must not be negative for them."""

    def __init__(self, spec: Spec, parameters: Mapping[str, ca.SX]) -> None:
        self.spec, self.parameters = spec, parameters
        self.limits: list[ca.SX] = []
        self._known: dict[Continuous, dict[str, ca.SX]] = {}

    def entry(self, entry: Computed) -> ca.SX:
        """One entry of one of them."""
        source = entry.whole
        if not isinstance(source, Continuous):
            raise InternalError(f"no expression: {entry!r}")
        if source not in self._known:
            matrices = {x: lift(getattr(source, x), self.parameters) for x in OF_TIME}
            T = lift_expression(source.T, self.parameters)
            count = doublings(self.spec, source)
            self._known[source], limits = discretised(source, matrices, T, count)
            self.limits += limits
        return self._known[source][entry.letter][entry.row, entry.column]


def lift(matrix: Matrix, parameters: Mapping[str, ca.SX], wholes: Wholes | None = None) -> ca.SX:
    """A matrix of expressions as SX; entries that are zero are not stored."""
    result = ca.SX(*matrix.shape)
    for i, row in enumerate(matrix.rows):
        for j, entry in enumerate(row):
            if entry != Number(0.0):
                result[i, j] = lift_expression(entry, parameters, wholes)
    return result


def lift_expression(  # noqa: PLR0911 - one per node
    expression: Expression, parameters: Mapping[str, ca.SX], wholes: Wholes | None = None
) -> ca.SX:
    """One expression of a spec as SX."""
    match expression:
        case Number(value):
            return ca.SX(value)
        case Name(identifier):
            return parameters[identifier]
        case Operation("interp", (argument,), Table() as table):
            return _looked_up(table, lift_expression(argument, parameters))
        case Operation("if", (condition, first, second)):
            a, b = (lift_expression(each, parameters) for each in (first, second))
            holds, fails = _alternatives(condition, parameters)
            return _where(holds, a) + _where(fails, b)
        case Operation(symbol, _) if symbol in COMPARISONS:
            return _alternatives(expression, parameters)[0]
        case Operation(symbol, arguments):
            return _OPERATIONS[symbol](*(lift_expression(a, parameters, wholes) for a in arguments))
        case Computed() if wholes is not None:
            return wholes.entry(expression)
    raise InternalError(f"no expression: {expression!r}")


def _where(condition: ca.SX, value: ca.SX) -> ca.SX:
    """The value where a condition holds (is 1), else 0: nothing of a value that may be NaN."""
    return ca.SX.binary(ca.OP_IF_ELSE_ZERO, condition, value)


def _alternatives(condition: Expression, parameters: Mapping[str, ca.SX]) -> tuple[ca.SX, ca.SX]:
    """Whether a condition holds and whether it does not, each 1 or 0."""
    symbol: str = "!="
    sides: tuple[Expression, ...] = condition, Number(0.0)
    if isinstance(condition, Operation) and condition.operator in COMPARISONS:
        symbol, sides = condition.operator, condition.arguments
    a, b = (lift_expression(side, parameters) for side in sides)
    if symbol in {"==", "!="}:
        pair = _where(a <= b, b <= a), (a < b) + (b < a)
        return pair if symbol == "==" else pair[::-1]
    if symbol in {">", "<="}:
        a, b, symbol = b, a, "<" if symbol == ">" else ">="
    return (a < b, b <= a) if symbol == "<" else (b <= a, a < b)


def _looked_up(table: Table, at: ca.SX) -> ca.SX:
    """A table at one place: the piece of the interval, or the end that holds."""
    result = _where(at < table.x[0], ca.SX(table.y[0]))
    for start, end, y, piece in zip(table.x, table.x[1:], table.y, table.pieces, strict=False):
        t, value = at - start, ca.SX(0)
        for coefficient in reversed(piece):
            value = (value + coefficient) * t
        result += _where(start <= at, _where(at < end, y + value))
    return result + _where(table.x[-1] <= at, ca.SX(table.y[-1]))


def _power(base: ca.SX, exponent: ca.SX) -> ca.SX:
    """Products for whole exponents, a square root for halves, exp(b log a) otherwise."""
    value = float(exponent) if exponent.is_constant() else math.nan
    if value == 0.5:
        return ca.sqrt(base)
    if not value.is_integer() or abs(value) > 64:
        return ca.exp(exponent * ca.log(base))
    result, square, remaining = ca.SX(1), base, int(abs(value))
    while remaining:
        if remaining % 2:
            result = result * square
        square, remaining = square * square, remaining // 2
    return 1 / result if value < 0 else result


_OPERATIONS: dict[str, Callable[..., ca.SX]] = {
    **{name: getattr(ca, name) for name in FUNCTIONS if hasattr(ca, name)},
    "abs": ca.fabs,
    "min": ca.fmin,
    "max": ca.fmax,
    "sign": lambda value: (value > 0) - (value < 0),
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "neg": operator.neg,
    "**": _power,
}
