"""Statements of one operation each, joined to expressions as long as a line holds.

A value that is used once stands where it is used, if nothing that it is made of has changed until
then. Operations, their order within an expression and their rounding stay: the bits do.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

from fkgen.backend.ir import (
    Assign,
    Call,
    Element,
    Expression,
    IfPositive,
    IfPresent,
    Operand,
    Operate,
    Operator,
    Statement,
    Temp,
    leaves,
    operands,
    walk,
)
from fkgen.backend.routines import Outline, Writer

Body = tuple[Statement, ...]

#: Printed as a question that names its arguments twice: they stay names, and so does the result.
_ASKING = {Operator.ABS, Operator.MAX, Operator.MIN}


def joined(found: Outline, fits: Callable[[Statement, int], bool]) -> Outline:
    """Expressions in place of values used once; ``fits(statement, depth)`` limits their length."""

    def body(body: Body) -> Body:
        temps = (o.index for n in walk(body) for o in operands(n) if isinstance(o, Temp))
        uses = Counter(temps)
        nodes = _Joiner(uses, fits).body(_stored(body, uses), 1)
        return Writer(lambda operand: operand, lambda row: row).many(nodes)

    return Outline(
        phases=tuple(replace(phase, body=body(phase.body)) for phase in found.phases),
        routines=tuple(replace(routine, body=body(routine.body)) for routine in found.routines),
    )


def _stored(body: Body, uses: Counter[int]) -> Body:
    """Let operations whose result goes to one place, and nowhere else, store it themselves."""
    nodes: dict[int, Statement] = dict(enumerate(body))
    origin = {n.target.index: i for i, n in enumerate(body) if isinstance(n, Operate)}
    last: dict[Element, int] = {}  # where an element was used last
    for i, node in enumerate(body):
        if isinstance(node, IfPresent | IfPositive):
            nodes[i] = replace(node, body=_stored(node.body, uses))
        if isinstance(node, Assign) and isinstance(node.value, Temp):
            at = origin.get(node.value.index)
            source = None if at is None else body[at]
            if at is not None and isinstance(source, Operate) and uses[node.value.index] == 1:
                called = any(isinstance(each, Call) for each in walk(body[at:i]))
                if not called and last.get(node.target, -1) <= at:
                    value = Expression(source.operator, source.arguments)
                    nodes[at] = Assign(node.target, value)
                    del nodes[i]
        last |= dict.fromkeys(_elements(node), i)
    return tuple(nodes[i] for i in sorted(nodes))


def _elements(node: Statement) -> Iterator[Element]:
    for inner in walk((node,)):
        yield from (o for o in operands(inner) if isinstance(o, Element))
        if isinstance(inner, Assign):
            yield inner.target


@dataclass(frozen=True, slots=True)
class _Joiner:
    """Walks a function and puts values into the statements that use them."""

    uses: Counter[int]
    fits: Callable[[Statement, int], bool]

    def body(self, body: Body, depth: int) -> Body:
        """One body; no value moves into a condition or out of it."""
        nodes: dict[int, Statement] = {}
        known: dict[Temp, tuple[int, Expression]] = {}  # where a value is made, and of what
        for i, node in enumerate(body):
            if isinstance(node, IfPresent | IfPositive):
                nodes[i] = replace(node, body=self.body(node.body, depth + 1))
            else:
                nodes[i], used = self._statement(node, depth, known)
                for temp in used:
                    del nodes[known[temp][0]]
            inside = list(walk((node,)))
            changed = {each.target for each in inside if isinstance(each, Assign)}
            called = any(isinstance(each, Call) for each in inside)
            known = {
                temp: (at, value)
                for temp, (at, value) in known.items()
                if not any(called or element in changed for element in _elements_of(value))
            }
            match nodes[i]:
                case Operate(target, operator, arguments) if operator not in _ASKING:
                    if self.uses[target.index] == 1:
                        known[target] = i, Expression(operator, arguments)
        return tuple(nodes[i] for i in sorted(nodes))

    def _statement(
        self, node: Statement, depth: int, known: Mapping[Temp, tuple[int, Expression]]
    ) -> tuple[Statement, list[Temp]]:
        """A statement with as many values in place as its line holds, and which."""
        used: list[Temp] = []
        if not isinstance(node, Operate | Assign) or _asks(node):
            return node, used
        for temp in operands(node):
            if isinstance(temp, Temp) and temp in known:
                longer = _with(node, temp, known[temp][1])
                if self.fits(longer, depth):
                    node = longer
                    used.append(temp)
        return node, used


def _asks(node: Operate | Assign) -> bool:
    match node:
        case Operate(_, operator, _) | Assign(_, Expression(operator, _)):
            return operator in _ASKING
    return False


def _elements_of(value: Operand) -> Iterator[Element]:
    return (leaf for leaf in leaves(value) if isinstance(leaf, Element))


def _with(node: Operate | Assign, temp: Temp, value: Expression) -> Operate | Assign:
    def put(operand: Operand) -> Operand:
        if isinstance(operand, Expression):
            return Expression(operand.operator, tuple(map(put, operand.arguments)))
        return value if operand == temp else operand

    if isinstance(node, Assign):
        return Assign(node.target, put(node.value))
    return Operate(node.target, node.operator, tuple(map(put, node.arguments)))
