"""Statements of one operation each, joined to expressions as long as a line holds.

A value that only the next statement uses stands there. Operations, their order and their rounding
stay, and so do the bits.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

from fkgen.backend import ir
from fkgen.backend.ir import Assign, Body, Element, Expression, Operate, Operator, Statement, Temp
from fkgen.backend.routines import Outline

#: Elements in a row that are worth a call.
LEAST_COPIED = 3
#: Lines that copies of arrays have to save, which need a function.
COPY_LINES = 15

#: Printed as a question that names its arguments twice: they stay names, and so does the result.
_ASKING = {Operator.ABS, Operator.MAX, Operator.MIN}


def joined(found: Outline, fits: Callable[[Statement, int], bool]) -> Outline:
    """Expressions in place of values used once; ``fits(statement, depth)`` limits their length."""

    def body(body: Body) -> Body:
        uses = Counter(ir.read(Temp, body))
        nodes: Body = ir.numbered(_joined(_stored(body, uses), uses, fits, 1))
        return nodes

    plain = _each(found, body)
    copied = _each(plain, _copied)
    copies = (copy for body in copied.bodies for copy in ir.every(ir.CopyArray, body))
    return copied if sum(copy.size - 1 for copy in copies) > COPY_LINES else plain


def _each(found: Outline, change: Callable[[Body], Body]) -> Outline:
    return Outline(
        phases=tuple(replace(phase, body=change(phase.body)) for phase in found.phases),
        routines=tuple(replace(each, body=change(each.body)) for each in found.routines),
    )


def _stored(body: Body, uses: Counter[Temp]) -> Body:
    """Let operations whose result goes to one place, and nowhere else, store it themselves."""
    nodes: dict[int, Statement] = dict(enumerate(body))
    origin = {n.target: i for i, n in enumerate(body) if isinstance(n, Operate)}
    last = _LastUse()
    for i, node in enumerate(body):
        if isinstance(node, ir.Nested):
            nodes[i] = replace(node, body=_stored(node.body, uses))
        if isinstance(node, Assign) and isinstance(node.value, Temp) and uses[node.value] == 1:
            at = origin.get(node.value, i)
            source = body[at]
            called = any(ir.every(ir.Call, body[at:i]))
            if isinstance(source, Operate) and not called and last.of(node.target) <= at:
                value = Expression(source.operator, source.arguments)
                nodes[at] = Assign(node.target, value)
                del nodes[i]
        last.take(ir.elements((node,)), i)
    return tuple(nodes[i] for i in sorted(nodes))


class _LastUse:
    """Where elements were used last; one that loops move may be any of its array."""

    def __init__(self) -> None:
        self._places: dict[Element, int] = {}
        self._moving: dict[tuple[ir.Space, str], int] = {}
        self._arrays: dict[tuple[ir.Space, str], int] = {}

    def take(self, elements: list[Element], at: int) -> None:
        """Elements are used at this place."""
        for each in elements:
            key = each.space, each.name
            self._places[each] = self._arrays[key] = at
            if each.moves:
                self._moving[key] = at

    def of(self, element: Element) -> int:
        """The last place where an element may have been used; -1 if there is none."""
        key = element.space, element.name
        if element.moves:
            return self._arrays.get(key, -1)
        return max(self._places.get(element, -1), self._moving.get(key, -1))


def _joined(
    body: Body, uses: Counter[Temp], fits: Callable[[Statement, int], bool], depth: int
) -> Body:
    """Put values into the statement right after them, the last one first; join what is required."""
    nodes: list[Statement] = []
    for each in body:
        node = each
        if isinstance(node, ir.Nested):
            node = replace(node, body=_joined(node.body, uses, fits, depth + 1))
        elif isinstance(node, ir.Require) and nodes and isinstance(before := nodes[-1], ir.Require):
            if (before.kind, before.status) == (node.kind, node.status):
                node = replace(node, values=(*before.values, *node.values))
                nodes.pop()
        elif isinstance(node, Operate | Assign) and not _asks(node):
            while nodes and (longer := _with(node, nodes[-1], uses)) and fits(longer, depth):
                node = longer
                nodes.pop()
        nodes.append(node)
    return tuple(nodes)


def _asks(node: Operate | Assign) -> bool:
    match node:
        case Operate(_, operator, _) | Assign(_, Expression(operator, _)):
            return operator in _ASKING
    return False


def _with(
    node: Operate | Assign, before: Statement, uses: Counter[Temp]
) -> Operate | Assign | None:
    """A statement with the value of the one before it in place of its name."""
    if not isinstance(before, Operate) or _asks(before) or uses[before.target] > 1:
        return None
    if before.target not in ir.operands(node):
        return None
    value = Expression(before.operator, before.arguments)
    longer: Operate | Assign = ir.mapped(
        node, lambda part: value if part == before.target else part
    )
    return longer


def _copied(body: Body) -> Body:
    """Elements that are copied one after the other, as copies of arrays."""
    nodes: list[Statement] = []
    run: list[tuple[Element, Element]] = []

    def close() -> None:
        long = len(run) >= LEAST_COPIED
        nodes.extend([ir.CopyArray(*run[0], len(run))] if long else [Assign(*pair) for pair in run])
        run.clear()

    for node in body:
        match node:
            case Assign(Element(index=int()) as to, Element(index=int()) as source):
                if run and (to, source) != tuple(each.shifted(1) for each in run[-1]):
                    close()
                run.append((to, source))
                continue
        close()
        if isinstance(node, ir.Nested):
            nodes.append(replace(node, body=_copied(node.body)))
        else:
            nodes.append(node)
    close()
    return tuple(nodes)
