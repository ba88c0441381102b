"""IR -> C text, one statement per operation: all the syntax there is."""

from __future__ import annotations

from collections.abc import Iterable
from functools import singledispatchmethod
from typing import Any

import numpy as np

from fkgen.backend.ir import (
    Assign,
    Call,
    Copy,
    CopyArray,
    CProgram,
    Element,
    Expression,
    Heading,
    IfPositive,
    IfPresent,
    Literal,
    Operand,
    Operate,
    Operator,
    Phase,
    Require,
    Routine,
    Row,
    RowArgument,
    Scalar,
    Space,
    Statement,
    Table,
    TableArgument,
    Temp,
    operands,
    walk,
)
from fkgen.backend.lines import WIDTH
from fkgen.errors import InternalError
from fkgen.symbolic.interface import Kind, Port, Status

_INFIX = {Operator.ADD: "+", Operator.SUB: "-", Operator.MUL: "*", Operator.DIV: "/"}
_WORD_BITS = 32


class StatementPrinter:
    """Print statements."""

    def __init__(self, name: str, scalar: Scalar, rows: int) -> None:
        self.name = name
        self.real = scalar
        self.rows = rows
        self.upper = name.upper()
        self.names: dict[float, str] = {}
        self.routines: dict[str, Routine] = {}
        self.needs: dict[str, set[str]] = {}
        self.elementary = name

    @property
    def limit(self) -> str:
        """The largest finite number."""
        return "DBL_MAX" if self.real == "double" else "FLT_MAX"

    @property
    def tiny(self) -> str:
        """The smallest normal number."""
        return "DBL_MIN" if self.real == "double" else "FLT_MIN"

    @property
    def words(self) -> int:
        """32-bit words that one bit per row of y needs."""
        return (self.rows + _WORD_BITS - 1) // _WORD_BITS

    def literal(self, value: float) -> str:
        """A constant that reads back as the same bits."""
        number: Any = float(value) if self.real == "double" else np.float32(value)
        if not np.isfinite(number):
            raise InternalError(f"{self.name}: constant {value} is not finite as {self.real}")
        text = np.format_float_scientific(number, trim="0", unique=True)
        if 1e-4 <= abs(number) < 1e16 or number == 0.0:
            text = np.format_float_positional(number, trim="0", unique=True)
        return text if self.real == "double" else text + "f"

    def word(self, value: int) -> str:
        """An integer constant as wide as the scalar type."""
        return f"UINT64_C({value:#x})" if self.real == "double" else f"UINT32_C({value:#x})"

    def status(self, status: Status) -> str:
        """Name of a status in the C enum."""
        return f"{self.upper}_{status.name}"

    def extent(self, port: Port) -> str:
        """Array brackets of a member; nothing for a scalar."""
        return f"[{port.size}]" if port.shape else ""

    def given(self, port: Port, at: str) -> str:
        """NaN where the port says nothing, in front of its value; for the record runner."""
        if not port.given:
            return ""
        return f"!(self->{port.given}{at} > {self.literal(0.0)}) ? ({self.real})NAN : "

    def bit(self, row: int) -> str:
        """Test of one row's bit in ``present``."""
        word = f"[{row // _WORD_BITS}]" if self.words > 1 else ""
        return f"(present{word} & {hex(1 << row % _WORD_BITS)}u) != 0u"

    def row(self, row: Row) -> str:
        """Test whether a row of y is present."""
        return f"row_{row.index} != 0" if isinstance(row, RowArgument) else self.bit(row)

    def fits(self, node: Statement, depth: int) -> bool:
        """Whether a statement stands on one line."""
        return len(self.statement(node, depth)) <= WIDTH

    def table(self, table: Table | TableArgument) -> str:
        """A row of constants."""
        if isinstance(table, TableArgument):
            return f"numbers_of_{table.index}"
        return f"{self.name}_{table.routine}_numbers[{table.row}]"

    def block(self, body: tuple[Statement, ...], depth: int = 1) -> str:
        """Statements with indentation."""
        return "\n".join(self.statement(node, depth) for node in body)

    @singledispatchmethod
    def statement(self, node: Statement, depth: int) -> str:
        """One statement as C."""
        raise InternalError(f"no C for {node!r} at depth {depth}")

    @statement.register
    def _(self, node: Operate, depth: int) -> str:
        value = self._operation(Expression(node.operator, node.arguments))
        return f"{_indent(depth)}const {self.real} {self.operand(node.target)} = {value};"

    def _operation(self, node: Expression) -> str:
        """An operation; what stands inside has parentheses, but for sums and products in a row."""
        a, zero = [self.operand(argument) for argument in node.arguments], self.literal(0.0)
        first, operator = node.arguments[0], node.operator
        match operator:
            case Operator.NEG:
                text = f"-{a[0]}"
            case Operator.ABS:
                text = f"({a[0]} > {zero}) ? {a[0]} : ({zero} - {a[0]})"
            case Operator.MAX:
                text = f"({a[0]} > {a[1]}) ? {a[0]} : {a[1]}"
            case Operator.MIN:
                text = f"({a[0]} < {a[1]}) ? {a[0]} : {a[1]}"
            case Operator.ADD | Operator.MUL if (
                isinstance(first, Expression) and first.operator is operator
            ):
                text = f"{self._operation(first)} {_INFIX[operator]} {a[1]}"
            case _ if operator in _INFIX:
                text = f"{a[0]} {_INFIX[operator]} {a[1]}"
            case _:
                inner = [self._bare(argument) for argument in node.arguments]
                text = f"{self.elementary}_{operator.value}({', '.join(inner)})"
        return text

    def _bare(self, operand: Operand) -> str:
        """An operand where nothing stands beside it."""
        if isinstance(operand, Expression):
            return self._operation(operand)
        return self.operand(operand)

    @statement.register
    def _(self, node: Copy, depth: int) -> str:
        value = self.operand(node.value)
        return f"{_indent(depth)}const {self.real} {self.operand(node.target)} = {value};"

    @statement.register
    def _(self, node: CopyArray, depth: int) -> str:
        source, target = self._address(node.source), self._address(node.target)
        return f"{_indent(depth)}{self.name}_copy({source}, {target}, {node.size});"

    @statement.register
    def _(self, node: Assign, depth: int) -> str:
        return f"{_indent(depth)}{self.operand(node.target)} = {self._bare(node.value)};"

    @statement.register
    def _(self, node: Require, depth: int) -> str:
        values, zero = [self.operand(value) for value in node.values], self.literal(0.0)
        match node.kind:
            case Kind.POSITIVE:
                holds = _all([f"{value} > {zero}" for value in values])
            case Kind.NONNEGATIVE:
                holds = _all([f"{value} >= {zero}" for value in values])
            case Kind.FINITE:
                defects = " + ".join(f"{self.name}_defect({value})" for value in values)
                return self._refusal(node, f"!{self.name}_finite({defects})", depth)
        return self._refusal(node, f"!({holds})", depth)

    def _refusal(self, node: Require, unless: str, depth: int) -> str:
        inner = f"{_indent(depth + 1)}return {self.status(node.status)};"
        return f"{_indent(depth)}if ({unless})\n{_braced(inner, depth)}"

    @statement.register
    def _(self, node: IfPresent, depth: int) -> str:
        one = 0 if node.row is None and self.rows == 1 else node.row
        test = self._any() if one is None else self.row(one)
        return f"{_indent(depth)}if ({test})\n{_braced(self.block(node.body, depth + 1), depth)}"

    @statement.register
    def _(self, node: IfPositive, depth: int) -> str:
        test = f"{self.operand(node.value)} > {self.literal(0.0)}"
        return f"{_indent(depth)}if ({test})\n{_braced(self.block(node.body, depth + 1), depth)}"

    @statement.register
    def _(self, node: Heading, depth: int) -> str:
        return f"\n{_indent(depth)}/* {node.text} */"

    @statement.register
    def _(self, node: Call, depth: int) -> str:
        routine = self.routines[node.routine]
        given = [
            self.operand(element) if argument.single else self._address(element)
            for argument, element in zip(routine.arguments, node.arguments, strict=True)
        ]
        if node.constants is not None:
            given.append(self.table(node.constants))
        given += map(self.table, node.tables)
        needs = self.needs[routine.name]
        given += [name for name in ("params", "present") if name in needs]
        given += [
            f"row_{row.index}" if isinstance(row, RowArgument) else f"({self.row(row)})"
            for row in node.rows
        ]
        call = f"{self.name}_{routine.name}({', '.join(given)});"
        if "status" not in needs:
            return f"{_indent(depth)}{call}"
        ok = self.status(Status.OK)
        test = f"{_indent(depth)}if (status != {ok})"
        refusal = _braced(f"{_indent(depth + 1)}return status;", depth)
        return f"{_indent(depth)}status = {call}\n{test}\n{refusal}"

    def _address(self, element: Element) -> str:
        text = self.operand(element)
        if element.index == 0:
            return text.removesuffix("[0]")
        return f"&{text}"

    def _any(self) -> str:
        words = [f"present[{i}]" for i in range(self.words)] if self.words > 1 else ["present"]
        return f"({' | '.join(words)}) != 0u"

    def operand(self, operand: Operand) -> str:
        """An operand as C."""
        match operand:
            case Temp(index):
                return f"t{index}"
            case Literal(value):
                return self.names.get(value) or self.literal(value)
            case Expression(operator):
                text = self._operation(operand)
                return text if operator.is_function else f"({text})"
            case Element(space, name, index):
                prefix = {Space.PARAMETER: "params->", Space.SELF: "self->", Space.NEXT: "next->"}
                place = "" if index is None else f"[{index}]"
                return f"{prefix.get(space, '')}{name}{place}"
        raise InternalError(f"no operand: {operand!r}")


class Printer(StatementPrinter):
    """Print the nodes of one program."""

    def __init__(self, program: CProgram) -> None:
        super().__init__(program.name, program.scalar, len(program.outputs))
        self.program = program
        if program.shares_functions:
            self.elementary = shared_prefix(program.scalar)
        self.names = {each.value: f"{self.upper}_{each.name}" for each in program.constants}

    def take(self, routines: tuple[Routine, ...]) -> None:
        """Learn the routines that may be called, callees first."""
        for routine in routines:
            self.routines[routine.name] = routine
            self.needs[routine.name] = self.needs_of(routine.body)

    def needs_of(self, body: tuple[Statement, ...]) -> set[str]:
        """What statements use besides arrays: ``params``, ``present``, a ``status`` to return."""
        needs: set[str] = set()
        for node in walk(body):
            if any(isinstance(o, Element) and o.space is Space.PARAMETER for o in operands(node)):
                needs.add("params")
            if isinstance(node, IfPresent) and not isinstance(node.row, RowArgument):
                needs.add("present")
            if isinstance(node, Require):
                needs.add("status")
            if isinstance(node, Call):
                needs |= self.needs[node.routine]
                if any(not isinstance(row, RowArgument) for row in node.rows):
                    needs.add("present")
        return needs

    def calls_that_refuse(self, body: tuple[Statement, ...]) -> bool:
        """Whether a call may return a status."""
        return any(isinstance(n, Call) and "status" in self.needs[n.routine] for n in walk(body))

    def head(self, routine: Routine) -> str:
        """Prototype of a routine."""
        needs = self.needs[routine.name]
        arguments = []
        for each in routine.arguments:
            pointer = "" if each.single else "*"
            const = "" if each.written else "const "
            arguments.append(f"{const}{self.real} {pointer}{each.name}")
        if routine.constants[0]:
            arguments.append(f"const {self.real} *numbers")
        arguments += [f"const {self.real} *numbers_of_{i}" for i in range(routine.tables)]
        if "params" in needs:
            arguments.append(f"const {self.name}_params_t *params")
        if "present" in needs:
            arguments.append("uint32_t present" if self.words == 1 else "const uint32_t *present")
        arguments += [f"int row_{i}" for i in range(routine.rows)]
        result = f"{self.name}_status_t" if "status" in needs else "void"
        head = f"{self.upper}_INLINE {result} {self.name}_{routine.name}"
        return f"{head}({', '.join(arguments) or 'void'})"

    @property
    def outcome(self) -> str:
        """Status of a sample with a row: that of the first outcome that applies."""
        text = self.status(Status.OK)
        sizes = {port.name: port.size for port in self.program.ports if port.shape}
        for outcome in reversed(self.program.outcomes):
            places = [f"[{i}]" for i in range(sizes.get(outcome.port, 0))] or [""]
            level = self.literal(outcome.level)
            above = " || ".join(f"(self->{outcome.port}{place} > {level})" for place in places)
            above = above if len(places) > 1 else above[1:-1]
            text = f"(({above}) ? {self.status(outcome.status)} : {text})"
        return text


def shared_prefix(scalar: Scalar) -> str:
    """Prefix of elementary functions of which all filters of a program share one copy."""
    return f"fkgen_{scalar}"


def copies_arrays(bodies: Iterable[tuple[Statement, ...]]) -> bool:
    """Whether arrays are copied."""
    return any(isinstance(node, CopyArray) for body in bodies for node in walk(body))


def tests_finiteness(phases: tuple[Phase, ...]) -> bool:
    """Whether a phase asks for finite numbers."""
    return any(
        isinstance(node, Require) and node.kind is Kind.FINITE
        for phase in phases
        for node in walk(phase.body)
    )


def _all(tests: list[str]) -> str:
    return tests[0] if len(tests) == 1 else " && ".join(f"({test})" for test in tests)


def _indent(depth: int) -> str:
    return "    " * depth


def _braced(inner: str, depth: int) -> str:
    return f"{_indent(depth)}{{\n{inner}\n{_indent(depth)}}}"
