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
from fkgen.backend.printer import StatementPrinter, step_of
from fkgen.errors import InternalError
from fkgen.symbolic.index import Index
from fkgen.symbolic.interface import Kind

_INFIX = {Operator.ADD: "+", Operator.SUB: "-", Operator.MUL: "*", Operator.DIV: "/"}

#: Columns of a product whose sums stand in registers at once.
SIDE = 4


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
        method = getattr(self, f"lane_{type(node).__name__.lower()}", None)
        if method is None:
            raise InternalError(f"no lanes for {node}")
        text: str = method(node, branch)
        return text

    def lane_heading(self, node: ir.Heading, _: Branch) -> str:
        """A comment."""
        return f"/* {node.text} */"

    def lane_operate(self, node: ir.Operate, _: Branch) -> str:
        """An operation; a logarithm that nobody may have asked for depends on that."""
        value = self.computed(node.operator, node.arguments)
        if ports := self.needless.get(node.target):
            places = [i for i, port in enumerate(self.program.ports) if port.name in ports]
            asked = " || ".join(f"(out[{i}] != NULL)" for i in places)
            value = f"({asked}) ? {value} : {self.name}_positive({self.vector(node.arguments[0])})"
        return f"const {self.lane_type} {self.operand(node.target)} = {value};"

    def lane_copy(self, node: ir.Copy, _: Branch) -> str:
        """A value that is kept."""
        return f"const {self.lane_type} {self.operand(node.target)} = {self.vector(node.value)};"

    def lane_assign(self, node: ir.Assign, branch: Branch) -> str:
        """An element gets a value."""
        return self._stored(self.operand(node.target), self.vector(node.value), branch)

    def _stored(self, target: str, value: str, branch: Branch) -> str:
        """An assignment; lanes that do not take the branch keep what they have."""
        if branch.mask:
            value = f"{self.name}_select({branch.mask}, {value}, {target})"
        return f"{target} = {value};"

    def lane_require(self, node: ir.Require, branch: Branch) -> str:
        """Mark the lanes that refuse; numbers have to be finite where their sum is."""
        values = [self.vector(value) for value in node.values]
        if node.kind is Kind.FINITE:
            added = [f"{self.name}_where({branch.mask}, {v})" if branch.mask else v for v in values]
            return "\n".join(f"sum = sum + {value};" for value in added)
        relation = ">" if node.kind is Kind.POSITIVE else ">="
        tests = [f"({self.mask_type})({v} {relation} {self.literal(0.0)})" for v in values]
        inside = f"{branch.mask} & " if branch.mask else ""
        return "\n".join(f"bad |= {inside}~{test};" for test in tests)

    def lane_ifpresent(self, node: ir.IfPresent, branch: Branch) -> str:
        """A branch of the lanes that have a row of y."""
        if isinstance(node.row, ir.RowArgument):
            raise InternalError("a row of a routine in a program")
        mask = "any_row" if node.row is None else f"present[{node.row}]"
        return self._under(mask, node.body, branch)

    def lane_ifpositive(self, node: ir.IfPositive, branch: Branch) -> str:
        """A branch of the lanes in which a value is positive."""
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

    def lane_for(self, node: ir.For, branch: Branch) -> str:
        """A loop, the same in all lanes."""
        head = f"for (int {node.index} = {node.begin}; {node.index} < {node.end}; ++{node.index})"
        return f"{head}\n{{\n{self.body(node.body, branch)}\n}}"

    def lane_triangle(self, node: ir.Triangle, branch: Branch) -> str:
        """Copy a triangle, and its mirror image."""
        source = self.vector(node.source)
        targets = [node.target, *([_mirrored(node.target)] if node.mirrored else [])]
        lines = [self._stored(self.operand(each), source, branch) for each in targets]
        return _loop("i", str(node.size), [_loop("j", "i + 1", lines)])

    def lane_product(self, node: ir.Product, branch: Branch) -> str:
        """Sums of several columns side by side, each one chain in ascending order of k."""
        end = "i + 1" if node.lower else str(node.columns)
        rows = ["int j = 0;"]
        for side in (SIDE, 1):
            lines = self._sums(node, side, branch)
            rows += [f"for (; j + {side} <= {end}; j += {side})", *_braced(lines)]
        return _loop("i", str(node.rows), rows)

    def _sums(self, node: ir.Product, side: int, branch: Branch) -> list[str]:
        """The sums of columns j, j + 1 and so on."""
        columns = range(side)
        first = node.start is None
        right = [_column(node.right, c) for c in columns]
        lines = [f"{self.lane_type} s{c};" for c in columns]
        terms = [f"s{c} = factor * {self.vector(right[c])};" for c in columns]
        factor = f"const {self.lane_type} factor = {self.vector(node.left)};"
        if node.start is None:
            lines += _braced(["const int k = 0;", factor, *terms])
        else:
            lines += [f"s{c} = {self.vector(_column(node.start, c))};" for c in columns]
        adding = {
            Operator.ADD: "s{c} = s{c} + factor * {r};",
            Operator.SUB: "s{c} = s{c} - factor * {r};",
            Operator.FMA: "s{c} = {n}_lane_fma(factor, {r}, s{c});",
            Operator.FNMA: "s{c} = {n}_lane_fma(-factor, {r}, s{c});",
        }[node.adding]
        links = [adding.format(c=c, r=self.vector(right[c]), n=self.name) for c in columns]
        lines.append(f"for (int k = {int(first)}; k < {node.inner}; ++k)")
        lines += _braced([factor, *links])
        targets = [self.operand(_column(node.target, c)) for c in columns]
        return lines + [self._stored(to, f"s{c}", branch) for c, to in enumerate(targets)]

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
        a, zero = [self.vector(argument) for argument in arguments], self.literal(0.0)
        match operator:
            case _ if operator in _INFIX:
                mixed = [self.operand(argument) for argument in arguments]
                one, other = mixed if not all(map(self.is_same, arguments)) else a
                text = f"{one} {_INFIX[operator]} {other}"
            case _ if operator in ir.FUSED:
                if (turned := ir.FUSED[operator]) is not None:
                    a[turned] = f"-{a[turned]}"
                text = f"{self.name}_lane_fma({', '.join(a)})"
            case Operator.NEG:
                text = f"-{a[0]}"
            case Operator.LT | Operator.LE:
                test = f"({self.mask_type})({a[0]} {operator.value} {a[1]})"
                text = f"{self.name}_where({test}, {self.name}_all({self.literal(1.0)}))"
            case Operator.IF_ELSE_ZERO:
                text = f"{self.name}_where(({self.mask_type})({a[0]} > {zero}), {a[1]})"
            case _:
                text = f"{self.name}_lane_{operator.value}({', '.join(a)})"
        return text


def _column(element: Element, by: int) -> Element:
    """The element some columns on."""
    return element.shifted(by * step_of(element, "j"))


def _mirrored(element: Element) -> Element:
    """The element in the mirror of the diagonal."""
    if not isinstance(element.index, Index):
        return element
    other = {"i": "j", "j": "i"}
    terms = sorted((other.get(name, name), a, b) for name, a, b in element.index.terms)
    return replace(element, index=replace(element.index, terms=tuple(terms)))


def _braced(lines: list[str]) -> list[str]:
    return ["{", *(f"    {line}" for line in lines), "}"]


def _loop(index: str, end: str, lines: list[str]) -> str:
    inside = "\n".join(lines).split("\n")
    return "\n".join([f"for (int {index} = 0; {index} < {end}; ++{index})", *_braced(inside)])
