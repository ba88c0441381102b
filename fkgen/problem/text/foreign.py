"""Values of other libraries, as lists, numbers and expressions.

NumPy, SymPy, CasADi and python-control objects are recognised by the module that defines their
type, so none of those libraries is imported unless the user has handed one of its objects over.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial, reduce
from importlib import import_module
from numbers import Real
from typing import Any

from fkgen.problem.table.place import Place, describe, show
from fkgen.problem.text.expression import (
    COMPARISONS,
    FUNCTIONS,
    MAX_DEPTH,
    MAX_NODES,
    ONE,
    ZERO,
    Expression,
    Name,
    Number,
    Operation,
    Unfit,
    is_large,
    operation,
    product,
    size,
    total,
)
from fkgen.problem.text.matrix import Matrix


def library(value: object) -> str:
    """Return which of the known libraries a value comes from, or an empty text."""
    for base in type(value).__mro__:
        root = (base.__module__ or "").partition(".")[0]
        if root in {"numpy", "sympy", "casadi", "control"}:
            return root
    return ""


def plain_list(value: Any, place: Place) -> object:
    """Return a list for anything list-like (a copy), rows for a matrix, else the value itself."""
    if isinstance(value, Matrix):
        return [list(row) for row in value.rows]
    if isinstance(value, list | tuple):
        return list(value)
    match library(value):
        case "numpy" | "sympy" if hasattr(value, "tolist"):
            return value.tolist()
        case "casadi":
            return _casadi_rows(value, place)
        case "control":
            raise place.error(describe(value), "a matrix; a StateSpace goes under 'model.system'")
        case _:
            return value


def plain_entry(value: Any, place: Place) -> object:
    """Return a plain number, a text or an expression for one scalar, else the value itself."""
    if isinstance(value, str | bool | int | float | Number | Name | Operation):
        return value
    match library(value):
        case "numpy" if hasattr(value, "tolist"):
            return value.tolist()
        case "sympy" if not hasattr(value, "tolist"):
            entry: object = sympy_tree(value, place)
        case "casadi":
            rows = _casadi_rows(value, place)
            entry = rows[0][0] if len(rows) == 1 and len(rows[0]) == 1 else rows
        case _:
            return value
    return entry.value if isinstance(entry, Number) else entry


def sympy_tree(
    value: Any,
    place: Place,
    named: Callable[[str], Name] = Name,
    shared: Callable[[Expression], Expression] | None = None,
) -> Expression:
    """Return a SymPy expression.

    ``shared`` gives what stands for a tree that is needed more than once, or is large; without it
    all is written out.
    """
    try:
        found = _SympyScalar(named)
        if shared is None:
            return found.converted(value)
        found.known = {}
        found.converted(value)  # counts what is needed how often
        return _SympyScalar(named, shared, found.needed, {}).converted(value)
    except Unfit as fault:
        expected = str(fault)
    except ArithmeticError as fault:
        expected = f"a finite real value, but {fault}"
    except RecursionError:
        expected = "an expression that is nested less deeply"
    raise place.error(show(value), expected)


#: Different parts of an expression, of which those that are equal are converted once.
MAX_DISTINCT = 10_000
#: Nodes of a tree that become a definition, if definitions are possible.
LARGE = 100


class _SympyScalar:
    """Converts one SymPy expression, node by node."""

    def __init__(
        self,
        named: Callable[[str], Name],
        shared: Callable[[Expression], Expression] | None = None,
        needed: Counter[Any] | None = None,
        known: dict[Any, Expression] | None = None,
    ) -> None:
        self.sympy: Any = import_module("sympy")
        self.named, self.shared, self.known = named, shared, known
        self.needed = Counter[Any]() if needed is None else needed
        self.count = 0

    def converted(self, node: Any) -> Expression:
        """The tree of a node, once where nodes are ``known``."""
        if self.shared is None:
            self.needed[node] += 1
        if self.known is not None and node in self.known:
            return self.known[node]
        self.count += 1
        most = MAX_NODES if self.known is None else MAX_DISTINCT
        if self.count > most:
            kind = "" if self.known is None else "different "
            raise Unfit(f"an expression of at most {most} {kind}terms and factors")
        tree = self.tree(node)
        if self.shared is not None and (self.needed[node] > 1 or size(tree) > LARGE):
            tree = self.shared(tree)
        if self.known is not None:
            self.known[node] = tree
        return tree

    def tree(self, node: Any) -> Expression:
        sympy = self.sympy
        if isinstance(node, sympy.Symbol):
            return self.named(str(node.name))
        if isinstance(node, sympy.Rational | sympy.Float) or node in {sympy.pi, sympy.E}:
            with suppress(OverflowError):
                if math.isfinite(number := float(node)):
                    return Number(number)
            raise Unfit("numbers that fit a double")
        if isinstance(node, sympy.Add):
            return total([self.converted(term) for term in node.args])
        if isinstance(node, sympy.Mul) or self.divides(node):
            return self.quotient(sympy.Mul.make_args(node))
        if isinstance(node, sympy.Piecewise):
            return self.choice(node)
        name, arguments = self.operation(node)
        operands = [self.converted(each) for each in arguments]
        several = name in {"min", "max", "*"}
        return reduce(partial(operation, name), operands) if several else operation(name, *operands)

    def choice(self, node: Any) -> Expression:
        """Convert a chain of conditions, of which the last one is always true."""
        *branches, (last, always) = node.args
        if always != self.sympy.true:
            raise Unfit("a Piecewise that ends with (value, True)")
        result = self.converted(last)
        for value, condition in reversed(branches):
            result = operation("if", self.converted(condition), self.converted(value), result)
        return result

    def quotient(self, factors: tuple[Any, ...]) -> Expression:
        below = [self.converted(1 / each) for each in factors if self.divides(each)]
        above = [self.converted(each) for each in factors if each != -1 and not self.divides(each)]
        result = operation("/", product(above), product(below)) if below else product(above)
        return operation("neg", result) if -1 in factors else result

    def operation(self, node: Any) -> tuple[str, tuple[Any, ...]]:
        kind = type(node).__name__
        name = kind.lower() if kind in {"Abs", "Min", "Max"} else kind
        if isinstance(node, self.sympy.Pow):
            root = node.exp == self.sympy.Rational(1, 2)
            return ("sqrt", node.args[:1]) if root else ("**", node.args)
        if isinstance(node, self.sympy.core.relational.Relational) and node.rel_op in COMPARISONS:
            return node.rel_op, node.args
        if isinstance(node, self.sympy.And):
            return "*", node.args
        own = self.sympy.Function | self.sympy.Min | self.sympy.Max
        if name in FUNCTIONS and isinstance(node, own):
            return name, node.args
        if name == "atan":
            return "atan2", (*node.args, self.sympy.Integer(1))
        raise Unfit(
            "numbers, symbols, + - * / **, comparisons, exp, log, sqrt, sin, cos, tan, asin, acos,"
            f" sinh, cosh, tanh, atan2, sign, Abs, Min, Max, Piecewise, pi and E, without {kind}"
        )

    def divides(self, node: Any) -> bool:
        return bool(isinstance(node, self.sympy.Pow) and node.exp.is_Rational and node.exp < 0)


_CASADI = {"ADD": "+", "SUB": "-", "MUL": "*", "DIV": "/", "NEG": "neg", "POW": "**"}
_CASADI |= {"CONSTPOW": "**", "FABS": "abs", "FMIN": "min", "FMAX": "max"}
_CASADI |= {"LT": "<", "LE": "<=", "EQ": "==", "NE": "!="}
_CASADI |= {name.upper(): name for name in FUNCTIONS}


def _casadi_rows(value: Any, place: Place) -> list[list[Any]]:
    """Return the rows of a CasADi SX (expressions, by its instructions) or DM matrix (numbers)."""
    casadi = import_module("casadi")
    if isinstance(value, casadi.DM):
        numbers: list[list[Any]] = value.full().tolist()
        return numbers
    return casadi_trees(value, place, Name)


def casadi_trees(
    value: Any,
    place: Place,
    named: Callable[[str], Name],
    shared: Callable[[Expression], Expression] | None = None,
) -> list[list[Expression]]:
    """Return the entries of an SX or DM matrix.

    ``shared`` gives what stands for a tree that is needed more than once, or is large.
    """
    casadi = import_module("casadi")
    value = casadi.SX(value) if isinstance(value, casadi.DM) else value
    if not isinstance(value, casadi.SX):
        raise place.error(describe(value), "a CasADi SX or DM matrix")
    kinds = {getattr(casadi, key): key[3:] for key in dir(casadi) if key.startswith("OP_")}
    symbols = casadi.symvar(value)
    function = casadi.Function("entries", symbols, [casadi.densify(value)])
    entries: list[list[Expression]] = [[ZERO] * value.shape[1] for _ in range(value.shape[0])]
    work: dict[int, Expression] = {}
    uses = _uses(function, kinds)
    for k in range(function.n_instructions()):
        kind = kinds[function.instruction_id(k)]
        inputs, outputs = function.instruction_input(k), function.instruction_output(k)
        if kind == "INPUT":
            work[outputs[0]] = named(str(symbols[inputs[0]].name()))
        elif kind == "CONST":
            constant = function.instruction_constant(k)
            if not math.isfinite(constant):
                hint = " (a function of Python's math takes no symbol, casadi's do)"
                expected = f"finite numbers{hint if math.isnan(constant) else ''}"
                raise place.error(f"an entry {constant}", expected)
            work[outputs[0]] = Number(constant)
        elif kind == "OUTPUT":
            column, row = divmod(outputs[1], value.shape[0])
            entries[row][column] = work[inputs[0]]
        else:
            tree = _casadi_result(kind, [work[index] for index in inputs], place)
            if shared is not None and (uses[k] > 1 or size(tree) > LARGE):
                tree = shared(tree)
            work[outputs[0]] = tree
    return entries


def _uses(function: Any, kinds: Mapping[int, str]) -> Counter[int]:
    """How often the result of each instruction is used."""
    origin: dict[int, int] = {}
    found: Counter[int] = Counter()
    for k in range(function.n_instructions()):
        kind = kinds[function.instruction_id(k)]
        if kind not in {"INPUT", "CONST"}:
            found.update(origin[each] for each in function.instruction_input(k))
        if kind != "OUTPUT":
            origin[function.instruction_output(k)[0]] = k
    return found


def _casadi_result(kind: str, arguments: list[Expression], place: Place) -> Expression:
    special = {
        "SQ": ("**", [arguments[0], Number(2.0)]),
        "TWICE": ("*", [Number(2.0), arguments[0]]),
        "INV": ("/", [ONE, arguments[0]]),
        "ATAN": ("atan2", [arguments[0], ONE]),
        "NOT": ("==", [arguments[0], ZERO]),
        "IF_ELSE_ZERO": ("if", [*arguments, ZERO]),
        "AND": ("*", [operation("!=", each, ZERO) for each in arguments]),
    }
    operator, operands = special.get(kind, (_CASADI.get(kind), arguments))
    if operator is None:
        supported = (
            "only + - * / **, comparisons, if_else, exp, log, sqrt, sin, cos, tan, asin, acos,"
            " atan, sinh, cosh, tanh, atan2, hypot, sign, fmin, fmax and fabs"
        )
        raise place.error(f"a CasADi matrix that uses {kind.lower()}", supported)
    try:
        result = operation(operator, *operands)
    except ArithmeticError as fault:
        raise place.error("a CasADi matrix", f"finite real values, but {fault}") from None
    if is_large(result):
        raise place.error(
            "a CasADi matrix",
            f"entries of at most {MAX_NODES} operations when written out, "
            f"nested at most {MAX_DEPTH} deep",
        )
    return result


def state_space(
    system: object, place: Place, *, continuous: bool = False
) -> tuple[dict[str, object], float | None]:
    """Take a python-control ``StateSpace`` apart."""
    known = library(system) == "control"
    if not known or not all(hasattr(system, key) for key in ("A", "B", "C", "D")):
        hint = "; convert it with control.ss" if known else ""
        raise place.error(describe(system), f"a control.StateSpace{hint}")
    dt: object = getattr(system, "dt", None)
    matrices = {key: getattr(system, key) for key in ("A", "B", "C", "D")}
    if continuous and isinstance(dt, Real) and float(dt) == 0.0:
        return matrices, None
    if dt is not True and not (isinstance(dt, Real) and float(dt) > 0):
        kind = "a model without a time base" if dt is None else "a continuous-time model"
        raise place.error(
            f"{kind} (dt = {show(dt)})",
            "a discrete-time model; state its dt, or model.time = 'continuous' and sample_time",
        )
    return matrices, None if dt is True else float(dt)
