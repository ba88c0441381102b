"""Expression trees: frozen, hashable, evaluated with plain arithmetic, never as Python.

Every operation is built by `operation`, which folds constants. So a tree that it built is in
normal form: writing it as text and parsing the text gives the same tree.
"""

from __future__ import annotations

import math
import operator as python_operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

FUNCTIONS: dict[str, int] = {
    "exp": 1,
    "log": 1,
    "sqrt": 1,
    "sin": 1,
    "cos": 1,
    "tan": 1,
    "atan2": 2,
    "abs": 1,
}
"""The functions of the expression language and the number of their arguments."""

MAX_DEPTH = 100
MAX_NODES = 2000


@dataclass(frozen=True, slots=True)
class Number:
    """A finite constant; minus zero is stored as zero, so that equal numbers print alike."""

    value: float

    def __post_init__(self) -> None:
        """Store a plain float."""
        object.__setattr__(self, "value", float(self.value) + 0.0)


@dataclass(frozen=True, slots=True)
class Name:
    """A parameter, by its name."""

    identifier: str


@dataclass(frozen=True, slots=True)
class Operation:
    """``operator(*arguments)``.

    Parameters
    ----------
    operator : str
        One of ``+ - * / **`` (two arguments), ``neg`` (one) or a key of `FUNCTIONS`.
    arguments : tuple of Expression
        The operands, in the order in which they are written.
    """

    operator: str
    arguments: tuple[Expression, ...]


Expression = Number | Name | Operation

ZERO = Number(0.0)
ONE = Number(1.0)

_COMPUTE: dict[str, Callable[..., float]] = {
    "+": python_operator.add,
    "-": python_operator.sub,
    "*": python_operator.mul,
    "/": python_operator.truediv,
    "**": math.pow,
    "neg": python_operator.neg,
    "exp": math.exp,
    "log": math.log,
    "sqrt": math.sqrt,
    "sin": math.sin,
    "cos": math.cos,
    "tan": math.tan,
    "atan2": math.atan2,
    "abs": abs,
}


def operation(operator: str, *arguments: Expression) -> Expression:
    """Return ``operator(*arguments)`` with constants folded.

    Raises
    ------
    ArithmeticError
        If all arguments are constants and the value is not a finite real number.
    """
    if all(isinstance(argument, Number) for argument in arguments):
        return Number(_compute(operator, [evaluate(argument, {}) for argument in arguments]))
    match operator, arguments:
        case (
            ("+", (Number(0.0), same))
            | ("+" | "-", (same, Number(0.0)))
            | ("*", (Number(1.0), same))
            | ("*" | "/" | "**", (same, Number(1.0)))
            | ("neg", (Operation("neg", (same,)),))
        ):
            return same
        case ("*", (Number(0.0), _) | (_, Number(0.0))):
            return ZERO
        case ("-", (Number(0.0), subtrahend)):
            return operation("neg", subtrahend)
        case _:
            return Operation(operator, arguments)


def total(terms: Sequence[Expression]) -> Expression:
    """Return the sum of the terms, as a balanced tree (shallow, however many there are)."""
    return _balanced("+", terms, ZERO)


def product(factors: Sequence[Expression]) -> Expression:
    """Return the product of the factors, as a balanced tree."""
    return _balanced("*", factors, ONE)


def _balanced(operator: str, operands: Sequence[Expression], neutral: Expression) -> Expression:
    if len(operands) < 2:
        return operands[0] if operands else neutral
    middle = (len(operands) + 1) // 2
    left, right = operands[:middle], operands[middle:]
    return operation(
        operator, _balanced(operator, left, neutral), _balanced(operator, right, neutral)
    )


def evaluate(expression: Expression, values: Mapping[str, float]) -> float:
    """Return the value of an expression.

    Parameters
    ----------
    expression : Expression
        The tree.
    values : mapping of str to float
        A value for every name in it.

    Raises
    ------
    ArithmeticError
        If any part of it is not a finite real number: a division by zero, a logarithm of
        something negative, an overflow. The message says which part.
    KeyError
        If a name has no value.
    """
    match expression:
        case Number(value):
            return value
        case Name(identifier):
            return float(values[identifier])
        case Operation(operator, arguments):
            return _compute(operator, [evaluate(argument, values) for argument in arguments])


def _compute(operator: str, values: Sequence[float]) -> float:
    if operator == "/" and values[1] == 0.0:
        message = f"division by zero in {_written(operator, values)}"
        raise ArithmeticError(message)
    try:
        result = _COMPUTE[operator](*values)
    except OverflowError:
        result = math.inf
    except ValueError:
        result = math.nan
    if not math.isfinite(result):
        fault = "is not a real number" if math.isnan(result) else "is too large"
        message = f"{_written(operator, values)} {fault}"
        raise ArithmeticError(message)
    return result


def _written(operator: str, values: Sequence[float]) -> str:
    if operator in FUNCTIONS:
        return f"{operator}({', '.join(map(repr, values))})"
    return f" {operator} ".join(f"({value!r})" if value < 0 else repr(value) for value in values)


def names(expression: Expression) -> frozenset[str]:
    """Return the parameters an expression depends on."""
    match expression:
        case Number():
            return frozenset()
        case Name(identifier):
            return frozenset({identifier})
        case Operation(_, arguments):
            return frozenset().union(*(names(argument) for argument in arguments))


def depth(expression: Expression) -> int:
    """Return the height of the tree; 1 for a leaf."""
    if isinstance(expression, Operation):
        return 1 + max(depth(argument) for argument in expression.arguments)
    return 1


def size(expression: Expression) -> int:
    """Return the number of nodes of the tree."""
    if isinstance(expression, Operation):
        return 1 + sum(size(argument) for argument in expression.arguments)
    return 1
