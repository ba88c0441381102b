"""IR -> C over a vector type: a number is a vector, a branch a mask, and no lane sees another.

Where a lane does not take a branch, every number keeps its bits; what is computed there goes
nowhere. A lane in which something is refused is marked, and does its sample again in scalars.
"""

from __future__ import annotations

import textwrap
from dataclasses import dataclass, replace

from fkgen.backend import ir
from fkgen.backend.ir import Element, Operator, Space
from fkgen.backend.lanes.wanted import needless_logarithms
from fkgen.backend.printer import StatementPrinter
from fkgen.errors import InternalError
from fkgen.symbolic.interface import Kind

_INFIX = {Operator.ADD: "+", Operator.SUB: "-", Operator.MUL: "*", Operator.DIV: "/"}


@dataclass(frozen=True, slots=True)
class Branch:
    """Where a statement stands: the mask of the lanes that take it; "" where all of them do."""

    mask: str = ""
    depth: int = 0


class LanesPrinter(StatementPrinter):
    """Print the statements of one program over lanes; one method for each kind."""

    def __init__(self, program: ir.CProgram) -> None:
        super().__init__(program.name, program.scalar, len(program.outputs))
        self.members = {port.name: port.member for port in program.ports if port.flags}
        self.program = program
        self.tables: frozenset[str] = frozenset()  # Locals that are the same in all lanes
        self.needless: dict[ir.Temp, frozenset[str]] = {}

    def phase(self, phase: ir.Phase) -> str:
        """The statements of a phase, indented once."""
        self.tables = frozenset(local.name for local in phase.locals if local.values)
        self.needless = needless_logarithms(self.program, phase)
        return self.body(phase.body, Branch())

    def body(self, body: ir.Body, branch: Branch) -> str:
        """Statements in a branch, indented once."""
        return textwrap.indent("\n".join(self.lane(node, branch) for node in body), "    ")

    def lane(self, node: ir.Statement, branch: Branch) -> str:
        """One statement as C."""
        method = getattr(self, f"_{type(node).__name__.lower()}", None)
        if method is None:
            raise InternalError(f"no lanes for {node}")
        text: str = method(node, branch)
        return text

    def _heading(self, node: ir.Heading, _: Branch) -> str:
        return f"/* {node.text} */"

    def _operate(self, node: ir.Operate, _: Branch) -> str:
        value = self.computed(node.operator, node.arguments)
        if ports := self.needless.get(node.target):
            places = [i for i, port in enumerate(self.program.ports) if port.name in ports]
            asked = " || ".join(f"(out[{i}] != NULL)" for i in places)
            value = f"({asked}) ? {value} : {self.name}_positive({self.vector(node.arguments[0])})"
        return f"const {self.lane_type} {self.operand(node.target)} = {value};"

    def _copy(self, node: ir.Copy, _: Branch) -> str:
        return f"const {self.lane_type} {self.operand(node.target)} = {self.vector(node.value)};"

    def _assign(self, node: ir.Assign, branch: Branch) -> str:
        target, value = self.operand(node.target), self.vector(node.value)
        if branch.mask:
            value = f"{self.name}_select({branch.mask}, {value}, {target})"
        return f"{target} = {value};"

    def _require(self, node: ir.Require, branch: Branch) -> str:
        """Mark the lanes that refuse; numbers have to be finite where their sum is."""
        values = [self.vector(value) for value in node.values]
        if node.kind is Kind.FINITE:
            added = [f"{self.name}_where({branch.mask}, {v})" if branch.mask else v for v in values]
            return "\n".join(f"sum = sum + {value};" for value in added)
        relation = ">" if node.kind is Kind.POSITIVE else ">="
        tests = [f"({self.mask_type})({v} {relation} {self.literal(0.0)})" for v in values]
        inside = f"{branch.mask} & " if branch.mask else ""
        return "\n".join(f"bad |= {inside}~{test};" for test in tests)

    def _ifpresent(self, node: ir.IfPresent, branch: Branch) -> str:
        if isinstance(node.row, ir.RowArgument):
            raise InternalError("a row of a routine in a program")
        mask = "any_row" if node.row is None else f"present[{node.row}]"
        return self._under(mask, node.body, branch)

    def _ifpositive(self, node: ir.IfPositive, branch: Branch) -> str:
        mask = f"({self.mask_type})({self.vector(node.value)} > {self.literal(0.0)})"
        return self._under(mask, node.body, branch)

    def _under(self, mask: str, body: ir.Body, branch: Branch) -> str:
        """A branch twice: as it is where all lanes take it, and with a mask where some do."""
        name = f"taken{branch.depth}"
        both = f"{branch.mask} & {mask}" if branch.mask else mask
        some = self.body(body, Branch(name, branch.depth + 1))
        ways = [f"if ({self.name}_any({name}))\n{{\n{some}\n}}"]
        if not branch.mask:
            every = self.body(body, replace(branch, depth=branch.depth + 1))
            ways.insert(0, f"if (!{self.name}_any(~{name}))\n{{\n{every}\n}}")
        asked = textwrap.indent("\nelse ".join(ways), "    ")
        return f"{{\n    const {self.mask_type} {name} = {both};\n{asked}\n}}"

    def _for(self, node: ir.For, branch: Branch) -> str:
        head = f"for (int {node.index} = {node.begin}; {node.index} < {node.end}; ++{node.index})"
        return f"{head}\n{{\n{self.body(node.body, branch)}\n}}"

    @property
    def lane_type(self) -> str:
        """One number of each record."""
        return f"{self.name}_lane_t"

    @property
    def mask_type(self) -> str:
        """All bits or none, in each lane."""
        return f"{self.name}_mask_t"

    def vector(self, operand: ir.Operand) -> str:
        """An operand as a vector."""
        text = self.operand(operand)
        return f"{self.name}_all({text})" if self.is_same(operand) else text

    def is_same(self, operand: ir.Operand) -> bool:
        """Whether it is a scalar, the same in all lanes."""
        if isinstance(operand, Element):
            return operand.space is Space.LOCAL and operand.name in self.tables
        return isinstance(operand, ir.Literal)

    def operand(self, operand: ir.Operand) -> str:
        """An operand as C; an operation in an operation has parentheses."""
        if isinstance(operand, ir.Expression):
            return f"({self.computed(operand.operator, operand.arguments)})"
        return super().operand(operand)

    def computed(self, operator: Operator, arguments: tuple[ir.Operand, ...]) -> str:
        """An operation over all lanes."""
        a = [self.vector(argument) for argument in arguments]
        match operator:
            case _ if operator in _INFIX:
                mixed = [self.operand(argument) for argument in arguments]
                one, other = mixed if not all(map(self.is_same, arguments)) else a
                return f"{one} {_INFIX[operator]} {other}"
            case Operator.NEG:
                return f"-{a[0]}"
            case Operator.LT | Operator.LE:
                test = f"({self.mask_type})({a[0]} {operator.value} {a[1]})"
                return f"{self.name}_where({test}, {self.name}_all({self.literal(1.0)}))"
            case Operator.IF_ELSE_ZERO:
                test = f"({self.mask_type})({a[0]} > {self.literal(0.0)})"
                return f"{self.name}_where({test}, {a[1]})"
        return f"{self.name}_lane_{operator.value}({', '.join(a)})"
