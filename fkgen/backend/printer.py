"""IR -> C text, one statement per operation: all the syntax there is."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fkgen.backend import ir
from fkgen.backend.ir import Element, Expression, Operator, Space
from fkgen.backend.lines import WIDTH
from fkgen.errors import InternalError, UnfitError
from fkgen.symbolic.index import Index, value
from fkgen.symbolic.interface import Kind, Port, Status

_INFIX = {Operator.ADD: "+", Operator.SUB: "-", Operator.MUL: "*", Operator.DIV: "/"}
_COMPARED = (Operator.LT, Operator.LE)
_PREFIX = {Space.PARAMETER: "params->", Space.SELF: "self->", Space.NEXT: "next->"}
_WORD_BITS = 32

#: Prefix of elementary functions of which all filters of a program share one copy, by scalar.
SHARED_PREFIX = "fkgen_{}"


class StatementPrinter:
    """Print statements."""

    def __init__(self, name: str, scalar: ir.Scalar, rows: int) -> None:
        self.name = self.elementary = name
        self.real = scalar
        self.upper = name.upper()
        self.names: dict[float, str] = {}
        self.members: dict[str, str] = {}  # Of ports that the instance holds under another name
        self.routines: dict[str, ir.Routine] = {}
        self.needs: dict[str, set[str]] = {}
        #: The largest finite number, and the smallest normal one
        kind = "DBL" if scalar == "double" else "FLT"
        self.limit, self.tiny = f"{kind}_MAX", f"{kind}_MIN"
        self.fma = "fma" if scalar == "double" else "fmaf"
        self.rows = rows
        self.words = -(-rows // _WORD_BITS)  # 32-bit words that one bit per row of y needs

    def literal(self, value: float) -> str:
        """A constant that reads back as the same bits."""
        number: Any = float(value) if self.real == "double" else np.float32(value)
        if not np.isfinite(number):
            raise UnfitError(self.name, f"the constant {value} is not finite as {self.real}")
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

    @property
    def valid(self) -> str:
        """Declaration of the bits of the rows of y that were measured."""
        return "uint32_t valid" if self.words == 1 else f"const uint32_t valid[{self.words}]"

    @property
    def present(self) -> str:
        """Declaration of the bits of the rows of y that are present."""
        return "uint32_t present" if self.words == 1 else "const uint32_t *present"

    @property
    def any_row(self) -> str:
        """Test whether any row of y is present."""
        words = [f"present[{i}]" for i in range(self.words)] if self.words > 1 else ["present"]
        return f"({' | '.join(words)}) != 0u"

    @property
    def any_rejected(self) -> str:
        """Test whether any row of y was rejected."""
        words = [f"self->rejected[{i}]" for i in range(self.words)]
        return f"({' | '.join(words) if self.words > 1 else 'self->rejected'}) != 0u"

    def any_of(self, rows: Sequence[int]) -> str:
        """Test whether any of these rows of y is present."""
        masks: dict[int, int] = {}
        for row in rows:
            word, bit = divmod(row, _WORD_BITS)
            masks[word] = masks.get(word, 0) | 1 << bit
        place = "present" if self.words == 1 else "present[{}]"
        words = [f"({place.format(word)} & {mask:#x}u)" for word, mask in masks.items()]
        return f"({' | '.join(words)}) != 0u"

    def row(self, row: ir.Row) -> str:
        """Test whether a row of y is present."""
        if isinstance(row, ir.RowArgument):
            return f"row_{row.index} != 0"
        if isinstance(row, Index):
            at = row if self.words == 1 else f"({row}) % {_WORD_BITS}"
            word = f"[({row}) / {_WORD_BITS}]" if self.words > 1 else ""
            return f"((present{word} >> ({at})) & 1u) != 0u"
        word = f"[{row // _WORD_BITS}]" if self.words > 1 else ""
        return f"(present{word} & {hex(1 << row % _WORD_BITS)}u) != 0u"

    def table(self, table: ir.Table | ir.TableArgument) -> str:
        """A row of constants."""
        if isinstance(table, ir.TableArgument):
            return f"numbers_of_{table.index}"
        return f"{self.name}_{table.routine}_numbers[{table.row}]"

    def fits(self, node: ir.Statement, depth: int) -> bool:
        """Whether a statement stands on one line."""
        return 4 * depth + len(self.statement(node)) <= WIDTH

    def block(self, body: ir.Body) -> str:
        """Statements, indented once."""
        return textwrap.indent("\n".join(map(self.statement, body)), "    ")

    def statement(self, node: ir.Statement) -> str:  # noqa: C901, PLR0911 - one per node
        """One statement as C."""
        match node:
            case ir.Operate(target, operator, arguments):
                value = self._operation(Expression(operator, arguments))
                return f"const {self.real} {self.operand(target)} = {value};"
            case ir.Copy(target, kept):
                return f"const {self.real} {self.operand(target)} = {self.operand(kept)};"
            case ir.CopyArray(to, source, size):
                return f"{self.name}_copy({self._address(source)}, {self._address(to)}, {size});"
            case ir.Assign(to, assigned):
                return f"{self.operand(to)} = {self._bare(assigned)};"
            case ir.Require():
                return _under(self._fails(node), f"    return {self.status(node.status)};")
            case ir.IfPresent(row, body):
                one = 0 if row is None and self.rows == 1 else row
                return _under(self.any_row if one is None else self.row(one), self.block(body))
            case ir.For(index, begin, end, body):
                head = f"for (int {index} = {begin}; {index} < {end}; ++{index})"
                return f"{head}\n{{\n{self.block(body)}\n}}"
            case ir.IfPositive(positive, body):
                return _under(f"{self.operand(positive)} > {self.literal(0.0)}", self.block(body))
            case ir.Product() | ir.Triangle():
                return self._of_matrices(node)
            case ir.Call():
                return self._call(node)
        return f"\n/* {node.text} */"

    def _operation(self, node: Expression) -> str:
        """An operation; what stands inside has parentheses, but for sums and products in a row."""
        a, zero = [self.operand(argument) for argument in node.arguments], self.literal(0.0)
        first, operator = node.arguments[0], node.operator
        match operator:
            case Operator.NEG:
                text = f"-{a[0]}"
            case Operator.ABS:
                text = f"({a[0]} > {zero}) ? {a[0]} : ({zero} - {a[0]})"
            case Operator.MAX | Operator.MIN:
                text = (
                    f"({a[0]} {'>' if operator is Operator.MAX else '<'} {a[1]}) ? {a[0]} : {a[1]}"
                )
            case Operator.LT | Operator.LE:
                text = f"({a[0]} {operator.value} {a[1]}) ? {self.literal(1.0)} : {zero}"
            case Operator.IF_ELSE_ZERO:
                text = f"({self._holds(first)}) ? {a[1]} : {zero}"
            case Operator.ADD | Operator.MUL if (
                isinstance(first, Expression) and first.operator is operator
            ):
                text = f"{self._operation(first)} {_INFIX[operator]} {a[1]}"
            case _ if operator in ir.FUSED:
                text = self._fused(node)
            case _ if operator in _INFIX:
                text = f"{a[0]} {_INFIX[operator]} {a[1]}"
            case _:
                inner = ", ".join(map(self._bare, node.arguments))
                text = f"{self.elementary}_{operator.value}({inner})"
        return text

    def _fused(self, node: Expression) -> str:
        """A call of fma(): of a difference one argument has the other sign."""
        arguments = [self._bare(argument) for argument in node.arguments]
        turned = ir.FUSED[node.operator]
        if turned is not None:
            text = self.operand(node.arguments[turned])
            arguments[turned] = text[1:] if text.startswith("-") else f"-{text}"
        return f"{self.fma}({', '.join(arguments)})"

    def _holds(self, condition: ir.Operand) -> str:
        """Test whether a condition, which is 0 or 1, holds."""
        if isinstance(condition, Expression) and condition.operator in _COMPARED:
            a, b = map(self.operand, condition.arguments)
            return f"{a} {condition.operator.value} {b}"
        return f"{self.operand(condition)} > {self.literal(0.0)}"

    def _bare(self, operand: ir.Operand) -> str:
        """An operand where nothing stands beside it."""
        if isinstance(operand, Expression):
            return self._operation(operand)
        return self.operand(operand)

    def _fails(self, node: ir.Require) -> str:
        values, zero = [self.operand(value) for value in node.values], self.literal(0.0)
        if node.kind is Kind.FINITE:
            defects = summed([f"{self.name}_defect({value})" for value in values])
            return f"!{self.name}_finite({defects})"
        relation = ">" if node.kind is Kind.POSITIVE else ">="
        return f"!({combined([f'{value} {relation} {zero}' for value in values], '&&')})"

    def _of_matrices(self, node: ir.OfMatrices) -> str:
        """A call of a function about whole matrices."""
        return self._product(node) if isinstance(node, ir.Product) else self._triangle(node)

    def _triangle(self, node: ir.Triangle) -> str:
        """A call of one of the two functions between packed symmetric matrices and whole ones."""
        whole = node.target if node.mirrored else node.source
        first, second = (self._address(_begin(element)) for element in (node.source, node.target))
        name = f"{self.name}_{'unpack' if node.mirrored else 'packed'}"
        return f"{name}({first}, {second}, {step_of(whole, 'i')}, {node.size});"

    def _product(self, node: ir.Product) -> str:
        """A call of the function for products; what is read element by element has two strides."""
        places = ((node.target, "i"), (node.start, "i"), (node.left, "ik"), (node.right, "k"))
        given = []
        for element, variables in places:
            if element is None:
                given += ["NULL", "0"]
                continue
            steps = [step_of(element, variable) for variable in "ijk"]
            given.append(self._address(_begin(element)))
            given += [str(steps["ijk".index(variable)]) for variable in variables]
            if element is not node.left and node.columns > 1 and steps[1] != 1:
                raise InternalError(f"{self.name}: columns of {element.name} lie apart")
        sizes = node.rows, node.columns, node.inner, int(node.less), int(node.lower)
        return f"{self.name}_product({', '.join([*given, *map(str, sizes)])});"

    def _call(self, node: ir.Call) -> str:
        routine, needs = self.routines[node.routine], self.needs[node.routine]
        given = [
            self.operand(element) if argument.single else self._address(element)
            for argument, element in zip(routine.arguments, node.arguments, strict=True)
        ]
        given += [self.table(table) for table in (node.constants, *node.tables) if table]
        given += [name for name in ("params", "present") if name in needs]
        given += [
            f"row_{row.index}" if isinstance(row, ir.RowArgument) else f"({self.row(row)})"
            for row in node.rows
        ]
        call = f"{self.name}_{routine.name}({', '.join(given)});"
        if "status" not in needs:
            return call
        refused = _under(f"status != {self.status(Status.OK)}", "    return status;")
        return f"status = {call}\n{refused}"

    def _address(self, element: Element) -> str:
        text = self.operand(element)
        return text.removesuffix("[0]") if element.index == 0 else f"&{text}"

    def operand(self, operand: ir.Operand) -> str:
        """An operand as C."""
        match operand:
            case ir.Temp(index):
                return f"t{index}"
            case ir.Literal(value):
                return self.names.get(value) or self.literal(value)
            case Expression(operator):
                text = self._operation(operand)
                called = operator.is_function or operator in ir.FUSED
                return text if called else f"({text})"
            case Element(space, name, index):
                place = "" if index is None else f"[{index}]"
                own = self.members.get(name, name) if space in {Space.SELF, Space.NEXT} else name
                return f"{_PREFIX.get(space, '')}{own}{place}"


class Printer(StatementPrinter):
    """Print the nodes of one program."""

    def __init__(self, program: ir.CProgram) -> None:
        super().__init__(program.name, program.scalar, len(program.outputs))
        self.program = program
        if program.shares_functions:
            self.elementary = SHARED_PREFIX.format(program.scalar)
        self.members = {port.name: port.member for port in program.ports if port.flags}
        self.names = {each.value: f"{self.upper}_{each.name}" for each in program.constants}

    def take(self, routines: Iterable[ir.Routine]) -> None:
        """Learn the routines that may be called, callees first."""
        for routine in routines:
            self.routines[routine.name] = routine
            self.needs[routine.name] = self._needs_of(routine.body)

    def _needs_of(self, body: ir.Body) -> set[str]:
        """What statements use besides arrays: ``params``, ``present``, a ``status`` to return."""
        calls = [*ir.every(ir.Call, body)]
        needs = set().union(*(self.needs[call.routine] for call in calls))
        asked = [node.row for node in ir.every(ir.IfPresent, body)]
        asked += [row for call in calls for row in call.rows]
        if any(element.space is Space.PARAMETER for element in ir.read(Element, body)):
            needs.add("params")
        if any(not isinstance(row, ir.RowArgument) for row in asked):
            needs.add("present")
        if any(ir.every(ir.Require, body)):
            needs.add("status")
        return needs

    def calls_that_refuse(self, body: ir.Body) -> bool:
        """Whether a call may return a status."""
        return any("status" in self.needs[call.routine] for call in ir.every(ir.Call, body))

    def head(self, routine: ir.Routine) -> str:
        """Prototype of a routine."""
        needs = self.needs[routine.name]
        arguments = [
            f"{'' if each.written else 'const '}{self.real} {'' if each.single else '*'}{each.name}"
            for each in routine.arguments
        ]
        arguments += [f"const {self.real} *numbers"] if routine.constants[0] else []
        arguments += [f"const {self.real} *numbers_of_{i}" for i in range(routine.tables)]
        arguments += [f"const {self.name}_params_t *params"] if "params" in needs else []
        arguments += [self.present] if "present" in needs else []
        arguments += [f"int row_{i}" for i in range(routine.rows)]
        result = f"{self.name}_status_t" if "status" in needs else "void"
        head = f"{self.upper}_INLINE {result} {self.name}_{routine.name}"
        return f"{head}({', '.join(arguments) or 'void'})"

    @property
    def padded(self) -> bool:
        """Whether the words at its end leave room in an instance, of doubles."""
        words = self.words * len(self.members) + 1
        return self.real == "double" and words % 2 > 0

    @property
    def outcome(self) -> str:
        """Status of a sample with a row: that of the first outcome that applies."""
        text = self.status(Status.OK)
        sizes = {port.name: port.size for port in self.program.ports if port.shape}
        for outcome in reversed(self.program.outcomes):
            places = [f"[{i}]" for i in range(sizes.get(outcome.port, 0))] or [""]
            level, port = self.literal(outcome.level), outcome.port
            member = self.members.get(port, port)
            above = combined([f"self->{member}{place} > {level}" for place in places], "||")
            text = f"(({above}) ? {self.status(outcome.status)} : {text})"
        return text


def _first(element: Element) -> int:
    """Where an element of a product is for i = j = k = 0."""
    return int(value(element.index or 0, dict.fromkeys("ijk", 0)))


def _begin(element: Element) -> Element:
    """The element there; a number alone has no index."""
    return element if element.index is None else replace(element, index=_first(element))


def step_of(element: Element, variable: str) -> int:
    """How far it moves with an index."""
    one = {**dict.fromkeys("ijk", 0), variable: 1}
    return int(value(element.index or 0, one)) - _first(element)


def combined(tests: list[str], how: str) -> str:
    """Tests joined by an operator, in parentheses if there are several."""
    return tests[0] if len(tests) == 1 else f" {how} ".join(f"({test})" for test in tests)


def summed(terms: list[str]) -> str:
    """A sum by halves, so that a processor can add several terms at once."""
    if len(terms) <= 2:
        return " + ".join(terms)
    middle = (len(terms) + 1) // 2
    halves = [summed(half) for half in (terms[:middle], terms[middle:])]
    return " + ".join(f"({half})" if " " in half else half for half in halves)


def _under(test: str, inner: str) -> str:
    return f"if ({test})\n{{\n{inner}\n}}"
