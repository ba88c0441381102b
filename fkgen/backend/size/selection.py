"""Leave ports out of a program, and with them the arithmetic that nothing else needs.

A port stays if it is asked for, if it decides what a call returns or which phase runs, or if a
phase reads it from the instance. What is left out is an ordinary local where the same phase reads
it, and gone elsewhere. A sample is refused for the same reasons as before, but not because a number
that is no longer shown would not be finite.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from fkgen.backend import ir
from fkgen.backend.ir import Element, Space
from fkgen.symbolic.interface import Kind, Port

#: The self-test compares it after every sample.
ALWAYS = "filtered_state"


@dataclass(slots=True)
class _Pruning:
    """Builder of one phase without what only ports need that are left out."""

    kept: frozenset[str]
    only_shown: frozenset[ir.Operand]  # Values of ports that are left out, and of no other
    needed: set[ir.Operand] = field(default_factory=set)
    arrays: set[tuple[Space, str]] = field(default_factory=set)  # of which something is needed
    moving: set[tuple[Space, str]] = field(default_factory=set)  # the same, which loops choose

    def loop(self, node: ir.For) -> ir.For | None:
        """A loop, of which one round reads what another one wrote."""
        known = -1
        while known < len(self.needed):
            known = len(self.needed)
            body = self.body(node.body)
        return replace(node, body=body) if body else None

    def body(self, body: ir.Body) -> ir.Body:
        """The statements that are needed, found from the last one on."""
        found = [each for node in reversed(body) if (each := self.statement(node)) is not None]
        return tuple(reversed(found))

    def statement(self, node: ir.Statement) -> ir.Statement | None:
        """A statement, or what is left of it."""
        left: ir.Statement | None = node
        match node:
            case ir.Require(values, Kind.FINITE) if not self.only_shown.isdisjoint(values):
                values = tuple(v for v in values if v not in self.only_shown)
                left = replace(node, values=values) if values else None
            case ir.IfPresent() | ir.IfPositive():
                body = self.body(node.body)
                left = replace(node, body=body) if body else None
            case ir.For():
                left = self.loop(node)
            case (
                ir.Operate(target)
                | ir.Copy(target)
                | ir.Assign(target)
                | ir.Product(target)
                | ir.Triangle(target)
            ):
                left = node if self._is_needed(target) or self._is_result(target) else None
        if left is not None:
            read = ir.operands(left)
            self.needed.update(read)
            elements = [each for each in read if isinstance(each, Element)]
            self.arrays.update((each.space, each.name) for each in elements)
            self.moving.update((each.space, each.name) for each in elements if each.moves)
        return left

    def _is_needed(self, target: ir.Operand) -> bool:
        """Whether something reads a target, or may, where loops move one of the two."""
        if target in self.needed or not isinstance(target, Element):
            return target in self.needed
        return (target.space, target.name) in (self.arrays if target.moves else self.moving)

    def _is_result(self, target: ir.Operand) -> bool:
        if not isinstance(target, Element) or target.space is not Space.NEXT:
            return False
        return target.name in self.kept


def selected(
    ports: tuple[Port, ...], phases: Mapping[str, ir.Phase], asked: Iterable[str]
) -> tuple[tuple[Port, ...], dict[str, ir.Phase]]:
    """The ports that stay if only some are asked for, and the phases without the others."""
    partners = {port.name: {port.given, port.corrected, port.slots} - {""} for port in ports}
    kept = {ALWAYS, *asked, *(phase.unless for phase in phases.values() if phase.unless)}
    while True:
        kept = kept.union(*(partners.get(name, set()) for name in kept))
        left = {name: _pruned(phase, frozenset(kept)) for name, phase in phases.items()}
        read = {
            e.name
            for phase in left.values()
            for e in ir.read(Element, phase.body)
            if e.space is Space.SELF
        }
        if read <= kept:
            break
        kept |= read
    sizes = {port.name: port.size for port in ports if port.name not in kept}
    members = tuple(port for port in ports if port.name in kept)
    return members, {name: _inward(phase, sizes) for name, phase in left.items()}


def _pruned(phase: ir.Phase, kept: frozenset[str]) -> ir.Phase:
    stored: dict[bool, set[ir.Operand]] = {True: set(), False: set()}
    for node in ir.every(ir.Assign, phase.body):
        if node.target.space is Space.NEXT:
            stored[node.target.name in kept].add(node.value)
    pruning = _Pruning(kept, frozenset(stored[False] - stored[True]))
    found: list[tuple[str, ir.Body]] = []
    for section, body in reversed(chunks_of(phase)):
        found.append((section, pruning.body(body)))
    return with_chunks(phase, _without_empty_headings(found[::-1]))


def _without_empty_headings(chunks: list[tuple[str, ir.Body]]) -> list[tuple[str, ir.Body]]:
    """Chunks without headings under which nothing is left."""
    left: list[tuple[str, ir.Body]] = []
    filled = False
    for section, body in reversed(chunks):
        nodes: list[ir.Statement] = []
        for node in reversed(body):
            if filled or not isinstance(node, ir.Heading):
                nodes.append(node)
            filled = not isinstance(node, ir.Heading)
        left.append((section, tuple(reversed(nodes))))
    return [chunk for chunk in reversed(left) if chunk[1]]


def chunks_of(phase: ir.Phase) -> list[tuple[str, ir.Body]]:
    """The chunks of a phase: the section that each belongs to, and its statements."""
    ends = [*(at for at, _ in phase.chunks[1:]), len(phase.body)]
    chunks = zip(phase.chunks, ends, strict=False)
    return [(section, phase.body[start:end]) for (start, section), end in chunks]


def with_chunks(phase: ir.Phase, chunks: list[tuple[str, ir.Body]]) -> ir.Phase:
    """A phase of these chunks, with the locals that they use."""
    everything: list[ir.Statement] = []
    begins = []
    for section, nodes in chunks:
        begins.append((len(everything), section))
        everything += nodes
    body = tuple(everything)
    used = {e.name for e in ir.elements(body) if e.space is Space.LOCAL}
    read = [*ir.read(Element, body)]
    return replace(
        phase,
        body=body,
        chunks=tuple(begins) or ((0, ""),),
        locals=tuple(local for local in phase.locals if local.name in used),
        reads_input=any(e.space is Space.INPUT and e.name == "u" for e in read),
        reads_parameters=any(e.space is Space.PARAMETER for e in read),
    )


def _inward(phase: ir.Phase, sizes: Mapping[str, int]) -> ir.Phase:
    """Ports that are left out as locals of the phase."""

    def part(part: Any) -> Any:
        if not (isinstance(part, Element) and part.space is Space.NEXT and part.name in sizes):
            return part
        return Element(Space.LOCAL, part.name, part.index if sizes[part.name] > 1 else None)

    body = ir.mapped(phase.body, part)
    used = {e.name for e in ir.elements(body) if e.space is Space.LOCAL} & sizes.keys()
    locals_ = tuple(ir.Local(name, sizes[name], None) for name in sorted(used))
    return replace(phase, body=body, locals=(*phase.locals, *locals_))
