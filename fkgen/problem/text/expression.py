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
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Any, Protocol, TypeVar

from fkgen.problem.table.place import Place, show, suggestion
from fkgen.problem.text.lookup import Table

#: The functions of the expression language and the number of their arguments.
FUNCTIONS = dict.fromkeys(("exp", "log", "sqrt", "sin", "cos", "tan", "asin", "acos"), 1)
FUNCTIONS |= dict.fromkeys(("sinh", "cosh", "tanh", "abs", "sign"), 1)
FUNCTIONS |= dict.fromkeys(("atan2", "hypot", "min", "max", "interp"), 2) | {"if": 3}
CONSTANTS = {"pi": math.pi}
#: Names that mean something in every expression.
WORDS = frozenset((*FUNCTIONS, *CONSTANTS))

#: Operators whose value is 1 where they hold and 0 where they do not.
COMPARISONS = ("<", "<=", ">", ">=", "==", "!=")
#: What decides on the values of its arguments, so that a NaN in them would be lost.
_DECIDING = frozenset((*COMPARISONS, "sign", "min", "max", "interp"))

Result = TypeVar("Result")

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

    #: One of + - * / **, `COMPARISONS` (two arguments), neg (one) or a key of `FUNCTIONS`
    operator: str
    arguments: tuple[Expression, ...]  # The operands, in the order in which they are written
    table: Table | None = None  # What ``interp`` looks up, its second argument in the text


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
    "<": python_operator.lt,
    "<=": python_operator.le,
    ">": python_operator.gt,
    ">=": python_operator.ge,
    "==": python_operator.eq,
    "!=": python_operator.ne,
    **{name: getattr(math, name) for name in FUNCTIONS if hasattr(math, name)},
    "abs": abs,
    "min": min,
    "max": max,
    "sign": lambda value: (value > 0.0) - (value < 0.0),
}


class Scope(dict[str, float]):
    """What expressions may name: the parameters, with their defaults, and tables."""

    def __init__(
        self,
        defaults: Mapping[str, float],
        tables: Sequence[Table] = (),
        vectors: Mapping[str, tuple[str, ...]] | None = None,
        told: Collection[str] = (),
    ) -> None:
        super().__init__(defaults)
        self.tables = {table.name: table for table in tables}
        self.vectors = dict(vectors or {})  # Names of parameters that are the parts of a vector
        self.told = frozenset(told)  # Those that a filter is told of faults


def operation(operator: str, *arguments: Expression, table: Table | None = None) -> Expression:
    """Return ``operator(*arguments)`` with constants folded."""
    if operator == "if" and isinstance(arguments[0], Number):
        return arguments[1] if arguments[0].value else arguments[2]
    if all(isinstance(argument, Number) for argument in arguments):
        return Number(evaluate(Operation(operator, arguments, table), {}))
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
            return Operation(operator, arguments, table)


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
        case Operation("if", (condition, first, second)):
            return evaluate(first if evaluate(condition, values) else second, values)
        case Operation("interp", (argument,), Table() as table):
            return table.value(evaluate(argument, values))
        case Computed():
            return expression.value(values)
        case Operation(operator, arguments):
            return _compute(operator, [evaluate(argument, values) for argument in arguments])


def _compute(operator: str, values: Sequence[float]) -> float:
    if operator == "/" and values[1] == 0.0:
        raise ArithmeticError(f"division by zero in {_written(operator, values)}")
    try:
        result = float(_COMPUTE[operator](*values))
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


def decisive(expression: Expression) -> Iterator[Expression]:
    """Yield what an expression decides by, such as both sides of a comparison.

    Where a branch is not taken, what it decides by is 0.
    """
    if not isinstance(expression, Operation):
        return
    if expression.operator == "if":
        condition, first, second = expression.arguments
        if not (isinstance(condition, Operation) and condition.operator in COMPARISONS):
            yield condition
        yield from decisive(condition)
        yield from (operation("if", condition, each, ZERO) for each in decisive(first))
        yield from (operation("if", condition, ZERO, each) for each in decisive(second))
        return
    if expression.operator in _DECIDING:
        yield from (each for each in expression.arguments if not isinstance(each, Number))
    for argument in expression.arguments:
        yield from decisive(argument)


def names(expression: Expression) -> frozenset[str]:
    """Return the parameters an expression depends on."""
    if isinstance(expression, Operation):
        return frozenset().union(*map(names, expression.arguments))
    if isinstance(expression, Computed):
        return expression.whole.names
    return frozenset({expression.identifier} if isinstance(expression, Name) else ())


def renamed(expression: Expression, names: Mapping[str, str]) -> Expression:
    """Return an expression with other names for some names."""
    if isinstance(expression, Name):
        return Name(names.get(expression.identifier, expression.identifier))
    if isinstance(expression, Operation):
        arguments = (renamed(each, names) for each in expression.arguments)
        return Operation(expression.operator, tuple(arguments), expression.table)
    return expression


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
_ALLOWED = re.compile(r"[A-Za-z0-9_.,+\-*/()<>=!\"' ]")
#: ``if`` is no name to Python; this is one, and no user can have written it.
_IF = re.compile(r"\bif(?= ?\()"), "if\N{MIDDLE DOT}"
_COMPARED: dict[type[ast.cmpop], str] = dict(
    zip((ast.Lt, ast.LtE, ast.Gt, ast.GtE, ast.Eq, ast.NotEq), COMPARISONS, strict=True)
)
BINARY = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "**"}
_LANGUAGE = f"numbers, parameters, + - * / ** ( ) {' '.join((*COMPARISONS, *FUNCTIONS))} and pi"
_WORDS: dict[type[ast.AST], str] = {
    ast.Attribute: "an attribute access",
    ast.Subscript: "an index",
    ast.Lambda: "a lambda",
    ast.IfExp: "Python's conditional (if(condition, a, b) is ours)",
    ast.Compare: "the operators in and is",
    ast.BoolOp: "a boolean operation (a product of comparisons holds where all of them do)",
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
    """Parse an expression; a `Scope` of parameters has the tables that it may look up."""
    where = Place("<text>", "expression") if place is None else place
    return placed(lambda: Reader(parameters).scalar(syntax(text), 1), text, where)


def placed(read: Callable[[], Result], text: str, place: Place) -> Result:
    """What is read from a text, or the error that names the place and the text."""
    try:
        return read()
    except Unfit as fault:
        expected = str(fault)
    except ArithmeticError as fault:
        expected = f"a finite real value, but {fault}"
    raise place.error(show(text), expected)


def syntax(text: str, allowed: re.Pattern[str] = _ALLOWED) -> ast.expr:
    """The tree that Python makes of a text, which has no other characters than the allowed."""
    line = " ".join(text.split())
    if len(text) > MAX_TEXT:
        raise Unfit(f"at most {MAX_TEXT} characters, not {len(text)}")
    if not line:
        raise Unfit("an expression, not an empty text")
    if strange := allowed.sub("", line):
        raise Unfit(f"an expression of {_LANGUAGE}, without {strange[0]!r}")
    opened = ((each in "([") - (each in ")]") for each in line)
    if max(accumulate(opened)) > MAX_DEPTH:
        raise Unfit(_NOT_SO_DEEP)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # "1or 2" is a warning to Python, a mistake to us
            return ast.parse(_IF[0].sub(_IF[1], line), mode="eval").body
    except (SyntaxError, ValueError, Warning):
        raise Unfit(f"an expression of {_LANGUAGE}") from None
    except (RecursionError, MemoryError):
        raise Unfit(_NOT_SO_DEEP) from None


class Reader:
    """Takes over what Python's syntax has in common with expressions, node by node."""

    def __init__(self, parameters: Collection[str] | None) -> None:
        self.parameters = parameters

    def scalar(self, node: ast.expr, level: int) -> Expression:  # noqa: PLR0911 - one per node
        """The number that a node stands for."""
        if level > MAX_DEPTH:
            raise Unfit(_NOT_SO_DEEP)
        match node:
            case ast.Constant(value):
                return _constant(value)
            case ast.Name(identifier):
                return self.name(identifier)
            case ast.UnaryOp(ast.UAdd(), operand):
                return self.scalar(operand, level + 1)
            case ast.UnaryOp(ast.USub(), operand):
                return operation("neg", self.scalar(operand, level + 1))
            case ast.BinOp(left, kind, right) if type(kind) in BINARY:
                sides = self.scalar(left, level + 1), self.scalar(right, level + 1)
                return operation(BINARY[type(kind)], *sides)
            case ast.Compare(left, kinds, others) if all(type(kind) in _COMPARED for kind in kinds):
                pairs = pairwise([self.scalar(side, level + 1) for side in (left, *others)])
                compared = zip(kinds, pairs, strict=True)
                return product([operation(_COMPARED[type(kind)], *pair) for kind, pair in compared])
            case ast.Call(ast.Name(function), arguments, []):
                name = "if" if function == _IF[1] else function
                _check_call(name, len(arguments))
                return self.called(name, arguments, level + 1)
        culprit: ast.AST = node.op if isinstance(node, ast.BinOp | ast.UnaryOp) else node
        if isinstance(node, ast.Call) and node.keywords:
            culprit = node.keywords[0]
        word = _WORDS.get(type(culprit), f"Python's {type(culprit).__name__}")
        raise Unfit(f"an expression of {_LANGUAGE}, without {word}")

    def name(self, identifier: str) -> Expression:
        """What a name stands for."""
        return _name(identifier, self.parameters)

    def called(self, function: str, arguments: list[ast.expr], level: int) -> Expression:
        """Return a call; of an ``if`` that is decided the other branch may have no value."""
        first = self.scalar(arguments[0], level)
        if function == "interp":
            return operation("interp", first, table=_table(arguments[1], self.parameters))
        if function == "if" and isinstance(first, Number):
            with suppress(ArithmeticError):
                self.scalar(arguments[2 if first.value else 1], level)
            return self.scalar(arguments[1 if first.value else 2], level)
        return operation(function, first, *(self.scalar(each, level) for each in arguments[1:]))


def _table(node: ast.expr, parameters: Collection[str] | None) -> Table:
    """Return the table whose name stands in quotes."""
    tables = parameters.tables if isinstance(parameters, Scope) else {}
    known = ", ".join(map(repr, tables)) or "of which the spec has none"
    expected = f"the name of one of [tables] ({known}) as second argument of 'interp'"
    match node:
        case ast.Constant(str() as name) if name in tables:
            return tables[name]
        case ast.Constant(str() as name):
            raise Unfit(f"{expected}, not {show(name)}{suggestion(name, tables)}")
        case ast.Name(name) if name in tables:
            raise Unfit(f"{expected}: write it as '{name}', in quotes")
    raise Unfit(f"{expected}, in quotes")


def _constant(value: object) -> Expression:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise Unfit(f"an expression of {_LANGUAGE}, without the constant {show(value)}")
    with suppress(OverflowError):
        if math.isfinite(number := float(value)):
            return Number(number)
    raise Unfit("numbers that fit a double")


def _name(identifier: str, parameters: Collection[str] | None) -> Expression:
    if identifier in CONSTANTS:
        return Number(CONSTANTS[identifier])
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


_STRENGTH = dict.fromkeys(COMPARISONS, 0) | {"+": 1, "-": 1, "*": 2, "/": 2, "neg": 3, "**": 4}
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
            looser = operator not in COMPARISONS
            first = _within(left, _ATOM if operator == "**" else strength + 1 - looser)
            return f"{first} {operator} {_within(right, strength + 1)}"
        case Operation(function, arguments, table):
            looked_up = [] if table is None else [f"'{table.name}'"]
            return f"{function}({', '.join([*map(to_text, arguments), *looked_up])})"


def _within(expression: Expression, required: int) -> str:
    text = to_text(expression)
    strength = _ATOM
    if isinstance(expression, Operation):
        strength = _STRENGTH.get(expression.operator, _ATOM)
    if text.startswith("-"):
        strength = 0
    return text if strength >= required else f"({text})"
