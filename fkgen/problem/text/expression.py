"""The expression language of spec files: text to a frozen tree and back.

Text is parsed by Python's `ast` and taken over node by node through a whitelist; nothing is ever
evaluated as Python. `operation` folds constants, so that text and tree determine each other.
"""

from __future__ import annotations

import ast
import math
import operator as python_operator
import re
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import accumulate
from typing import Any, Protocol

from fkgen.problem.table.place import Place, show, suggestion

#: The functions of the expression language and the number of their arguments.
FUNCTIONS = {"exp": 1, "log": 1, "sqrt": 1, "sin": 1, "cos": 1, "tan": 1, "atan2": 2, "abs": 1}

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
    """``operator(*arguments)``."""

    operator: str  # One of + - * / ** (two arguments), neg (one) or a key of `FUNCTIONS`
    arguments: tuple[Expression, ...]  # The operands, in the order in which they are written


class Whole(Protocol):
    """Matrices that are computed as a whole, by letter."""

    @property
    def names(self) -> frozenset[str]:
        """The parameters they depend on."""

    def at(self, values: tuple[tuple[str, float], ...]) -> Mapping[str, Any]:
        """Their values as arrays."""


@dataclass(frozen=True, slots=True)
class Computed:
    """One entry of a matrix that is computed as a whole."""

    whole: Whole
    letter: str
    row: int
    column: int

    def value(self, values: Mapping[str, float]) -> float:
        """The entry for given parameters."""
        own = tuple((name, float(values[name])) for name in sorted(self.whole.names))
        return float(self.whole.at(own)[self.letter][self.row, self.column])


Expression = Number | Name | Operation | Computed

ZERO = Number(0.0)
ONE = Number(1.0)

_COMPUTE: dict[str, Callable[..., float]] = {
    "+": python_operator.add,
    "-": python_operator.sub,
    "*": python_operator.mul,
    "/": python_operator.truediv,
    "**": math.pow,
    "neg": python_operator.neg,
    **{name: getattr(math, name, abs) for name in FUNCTIONS},
}


def operation(operator: str, *arguments: Expression) -> Expression:
    """Return ``operator(*arguments)`` with constants folded."""
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
    halves = (_balanced(operator, half, neutral) for half in (operands[:middle], operands[middle:]))
    return operation(operator, *halves)


def evaluate(expression: Expression, values: Mapping[str, float]) -> float:
    """Return the value of an expression."""
    match expression:
        case Number(value):
            return value
        case Name(identifier):
            return float(values[identifier])
        case Computed():
            return expression.value(values)
        case Operation(operator, arguments):
            return _compute(operator, [evaluate(argument, values) for argument in arguments])


def _compute(operator: str, values: Sequence[float]) -> float:
    if operator == "/" and values[1] == 0.0:
        raise ArithmeticError(f"division by zero in {_written(operator, values)}")
    try:
        result = _COMPUTE[operator](*values)
    except OverflowError:
        result = math.inf
    except ValueError:
        result = math.nan
    if not math.isfinite(result):
        fault = "is not a real number" if math.isnan(result) else "is too large"
        raise ArithmeticError(f"{_written(operator, values)} {fault}")
    return result


def _written(operator: str, values: Sequence[float]) -> str:
    if operator in FUNCTIONS:
        return f"{operator}({', '.join(map(repr, values))})"
    return f" {operator} ".join(f"({value!r})" if value < 0 else repr(value) for value in values)


def names(expression: Expression) -> frozenset[str]:
    """Return the parameters an expression depends on."""
    if isinstance(expression, Operation):
        return frozenset().union(*map(names, expression.arguments))
    if isinstance(expression, Computed):
        return expression.whole.names
    return frozenset({expression.identifier} if isinstance(expression, Name) else ())


def depth(expression: Expression) -> int:
    """Return the height of the tree; 1 for a leaf."""
    arguments = expression.arguments if isinstance(expression, Operation) else ()
    return 1 + max(map(depth, arguments), default=0)


def size(expression: Expression) -> int:
    """Return the number of nodes of the tree."""
    arguments = expression.arguments if isinstance(expression, Operation) else ()
    return 1 + sum(map(size, arguments))


def is_large(expression: Expression) -> bool:
    """Whether a computed expression is too large to be written."""
    return size(expression) > MAX_NODES or depth(expression) > MAX_DEPTH


MAX_TEXT = 10_000
_ALLOWED = re.compile(r"[A-Za-z0-9_.,+\-*/() ]")
_BINARY = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "**"}
_LANGUAGE = f"numbers, parameters, + - * / ** ( ) and {' '.join(FUNCTIONS)}"
_WORDS: dict[type[ast.AST], str] = {
    ast.Attribute: "an attribute access",
    ast.Subscript: "an index",
    ast.Lambda: "a lambda",
    ast.Compare: "a comparison",
    ast.BoolOp: "a boolean operation",
    ast.IfExp: "a conditional",
    ast.NamedExpr: "an assignment",
    ast.Tuple: "a comma outside a call",
    ast.keyword: "a keyword argument",
    ast.Starred: "an unpacking",
    ast.FloorDiv: "the operator //",
    ast.Not: "the operator not",
}


class Unfit(Exception):
    """What is expected of an expression in place of what it is."""


_NOT_SO_DEEP = f"at most {MAX_DEPTH} levels of nesting"


def parse(
    text: str, *, place: Place | None = None, parameters: Collection[str] | None = None
) -> Expression:
    """Parse an expression."""
    where = Place("<text>", "expression") if place is None else place
    try:
        return _converted(_tree(text), 1, parameters)
    except Unfit as fault:
        expected = str(fault)
    except ArithmeticError as fault:
        expected = f"a finite real value, but {fault}"
    raise where.error(show(text), expected)


def _tree(text: str) -> ast.expr:
    line = " ".join(text.split())
    if len(text) > MAX_TEXT:
        raise Unfit(f"at most {MAX_TEXT} characters, not {len(text)}")
    if not line:
        raise Unfit("an expression, not an empty text")
    if strange := _ALLOWED.sub("", line):
        raise Unfit(f"an expression of {_LANGUAGE}, without {strange[0]!r}")
    if max(accumulate((each == "(") - (each == ")") for each in line)) > MAX_DEPTH:
        raise Unfit(_NOT_SO_DEEP)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # "1or 2" is a warning to Python, a mistake to us
            return ast.parse(line, mode="eval").body
    except (SyntaxError, ValueError, Warning):
        raise Unfit(f"an expression of {_LANGUAGE}") from None
    except (RecursionError, MemoryError):
        raise Unfit(_NOT_SO_DEEP) from None


def _converted(node: ast.expr, level: int, parameters: Collection[str] | None) -> Expression:
    if level > MAX_DEPTH:
        raise Unfit(_NOT_SO_DEEP)
    convert = partial(_converted, level=level + 1, parameters=parameters)
    match node:
        case ast.Constant(value):
            return _constant(value)
        case ast.Name(identifier):
            return _name(identifier, parameters)
        case ast.UnaryOp(ast.UAdd(), operand):
            return convert(operand)
        case ast.UnaryOp(ast.USub(), operand):
            return operation("neg", convert(operand))
        case ast.BinOp(left, kind, right) if type(kind) in _BINARY:
            return operation(_BINARY[type(kind)], convert(left), convert(right))
        case ast.Call(ast.Name(function), arguments, []):
            _check_call(function, len(arguments))
            return operation(function, *map(convert, arguments))
    culprit: ast.AST = node.op if isinstance(node, ast.BinOp | ast.UnaryOp) else node
    if isinstance(node, ast.Call) and node.keywords:
        culprit = node.keywords[0]
    word = _WORDS.get(type(culprit), f"Python's {type(culprit).__name__}")
    raise Unfit(f"an expression of {_LANGUAGE}, without {word}")


def _constant(value: object) -> Expression:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise Unfit(f"an expression of {_LANGUAGE}, without the constant {show(value)}")
    with suppress(OverflowError):
        if math.isfinite(number := float(value)):
            return Number(number)
    raise Unfit("numbers that fit a double")


def _name(identifier: str, parameters: Collection[str] | None) -> Expression:
    if parameters is None or identifier in parameters:
        return Name(identifier)
    if identifier in FUNCTIONS:
        raise Unfit(f"arguments in parentheses after the function '{identifier}'")
    if not parameters:
        raise Unfit(f"no name '{identifier}': the spec has no [parameters]")
    hint = suggestion(identifier, parameters)
    raise Unfit(f"only parameters ({', '.join(parameters)}), not the name '{identifier}'{hint}")


def _check_call(function: str, given: int) -> None:
    if function not in FUNCTIONS:
        hint = suggestion(function, FUNCTIONS)
        raise Unfit(f"one of the functions {', '.join(FUNCTIONS)}, not '{function}'{hint}")
    count = FUNCTIONS[function]
    if given != count:
        raise Unfit(f"{count} argument{'s' * (count > 1)} of '{function}', not {given}")


_STRENGTH = {"+": 1, "-": 1, "*": 2, "/": 2, "neg": 3, "**": 4}
_ATOM = 5


def to_text(expression: Expression) -> str:
    """Return an expression as text; `parse` of it is the expression again."""
    match expression:
        case Number(value):
            return repr(value)
        case Name(identifier):
            return identifier
        case Computed(_, letter, row, column):
            return f"{letter}[{row}][{column}]"
        case Operation("neg", (operand,)):
            return f"-{_within(operand, _STRENGTH['**'])}"
        case Operation(operator, (left, right)) if operator in _STRENGTH:
            strength = _STRENGTH[operator]
            first = _within(left, _ATOM if operator == "**" else strength)
            return f"{first} {operator} {_within(right, strength + 1)}"
        case Operation(function, arguments):
            return f"{function}({', '.join(map(to_text, arguments))})"


def _within(expression: Expression, required: int) -> str:
    text = to_text(expression)
    strength = _ATOM
    if isinstance(expression, Operation):
        strength = _STRENGTH.get(expression.operator, _ATOM)
    if text.startswith("-"):
        strength = 0
    return text if strength >= required else f"({text})"
