"""Leave out tests of numbers that are finite if another tested number is.

A sum, a difference or a product is finite only if all of its parts are, a quotient only if what is
divided is: an innovation that is not finite shows in the likelihood. What a condition may have left
alone is known on one of the two ways only, and known at all where it is on both. A sample is
refused for the same reason as before: a test may rely on those that come with it, with no test for
another reason between them, and on all before it.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

from fkgen.backend import ir
from fkgen.backend.ir import Element, Literal, Operator, Space
from fkgen.backend.size.selection import chunks_of, with_chunks
from fkgen.symbolic.interface import Kind

#: Operators whose result is finite only if every argument is.
_SPREADING = frozenset(
    {
        *(Operator.ADD, Operator.SUB, Operator.MUL, Operator.NEG, Operator.ABS),
        *(Operator.SQRT, Operator.LOG),
        *ir.FUSED,
    }
)

#: Conditions that hold, each with whether it does, at most this many together.
Way = frozenset[tuple[Hashable, bool]]
_ALWAYS: Way = frozenset()
_DEEPEST = 2


def without_implied(phase: ir.Phase) -> ir.Phase:
    """The phase without tests that always hold where those that stay do."""
    trace = _Trace()
    for local in phase.locals:
        for i in range(local.size if local.initial is not None else 0):
            element = Element(Space.LOCAL, local.name, i if local.size > 1 else None)
            trace.latest[element] = trace.number(Literal(local.initial or 0.0))
    trace.body(phase.body)
    needless = trace.implied()
    if not needless:
        return phase
    chunks = [
        (section, tuple(left for node in nodes for left in _lightened(node, needless)))
        for section, nodes in chunks_of(phase)
    ]
    return with_chunks(phase, chunks)


def _lightened(node: ir.Statement, needless: set[tuple[int, int]]) -> Iterator[ir.Statement]:
    if not isinstance(node, ir.Require):
        yield node
        return
    values = tuple(v for i, v in enumerate(node.values) if (id(node), i) not in needless)
    if values:
        yield replace(node, values=values)


@dataclass(frozen=True, slots=True)
class _Tested:
    """A number that is tested: in which statement, at which place, and after how many others."""

    place: tuple[int, int]
    number: int
    stage: int


@dataclass(slots=True)
class _Trace:
    """Every number that a phase computes, numbered, with what is finite if it is."""

    #: For each number those it is computed from, and on which way
    parts: list[tuple[tuple[int, Way], ...]] = field(default_factory=list)
    constants: set[int] = field(default_factory=set)
    latest: dict[Any, int] = field(default_factory=dict)  # The number that each operand is now
    computed: dict[Any, int] = field(default_factory=dict)  # By operator and arguments
    tested: list[_Tested] = field(default_factory=list)
    stage: int = 0

    def body(self, body: ir.Body, *, outside: bool = True) -> None:
        """Follow statements; those ``outside`` of conditions test numbers for sure."""
        for node in body:
            match node:
                case ir.Operate(target, operator, arguments):
                    given = arguments if operator in _SPREADING else ()
                    given = arguments[:1] if operator is Operator.DIV else given
                    parts = tuple((self.number(each), _ALWAYS) for each in given)
                    same = operator, tuple(map(self.number, arguments))
                    if same not in self.computed:
                        self.computed[same] = self._new(parts)
                    self.latest[target] = self.computed[same]
                case ir.Copy(target, value) | ir.Assign(target, value):
                    self.latest[target] = self.number(value)
                case ir.Require(values, Kind.FINITE) if outside:
                    numbers = map(self.number, values)
                    places = ((id(node), i) for i in range(len(values)))
                    self.tested += map(_Tested, places, numbers, [self.stage] * len(values))
                case ir.Require():
                    self.stage += 1
                case ir.IfPresent() | ir.IfPositive():
                    self._branch(node)
                case ir.For() | ir.Product() | ir.Triangle():
                    self._forget(node)

    def _forget(self, node: ir.For | ir.OfMatrices) -> None:
        """Arrays that loops or products write hold other numbers afterwards."""
        written = {(e.target.space, e.target.name) for e in ir.stores((node,))}
        for each in [e for e in self.latest if isinstance(e, Element)]:
            if (each.space, each.name) in written:
                del self.latest[each]

    def _branch(self, node: ir.IfPresent | ir.IfPositive) -> None:
        """Statements that run or not: what they assign is one of two numbers afterwards."""
        key: Hashable = ("row", node.row) if isinstance(node, ir.IfPresent) else id(node)
        targets = dict.fromkeys(each.target for each in ir.every(ir.Assign, node.body))
        before = [self.number(target) for target in targets]
        self.body(node.body, outside=False)
        for target, old in zip(targets, before, strict=True):
            new = self.number(target)  # which nobody knows, if a loop wrote it
            self.latest[target] = self._new(
                ((new, frozenset({(key, True)})), (old, frozenset({(key, False)})))
            )

    def number(self, operand: ir.Operand) -> int:
        """The number that an operand is now."""
        if operand not in self.latest:
            self.latest[operand] = self._new(())
            if isinstance(operand, ir.Literal) and math.isfinite(operand.value):
                self.constants.add(self.latest[operand])
        return self.latest[operand]

    def _new(self, parts: tuple[tuple[int, Way], ...]) -> int:
        self.parts.append(parts)
        return len(self.parts) - 1

    def implied(self) -> set[tuple[int, int]]:
        """Places of the tests that are needless."""
        needless: set[tuple[int, int]] = set()
        for stage in sorted({each.stage for each in self.tested}):
            needless |= self._implied(stage)
        return needless

    def _implied(self, stage: int) -> set[tuple[int, int]]:
        """The same for the tests of one stage, from the last number to the first."""
        tests: dict[int, list[_Tested]] = {}
        for each in self.tested:
            if each.stage <= stage:
                tests.setdefault(each.number, []).append(each)
        needless = set()
        known: dict[int, set[Way]] = {}
        for number in range(max(tests), -1, -1):
            ways = _merged(known.pop(number, set()))
            if number in tests:
                kept = 0 if self._holds(number, ways) else 1
                needless |= {e.place for e in tests[number][kept:] if e.stage == stage}
                ways = {_ALWAYS}
            for part, condition in self.parts[number]:
                known.setdefault(part, set()).update(_narrowed(ways, condition))
        return needless

    def _holds(self, number: int, ways: set[Way]) -> bool:
        """Whether a number is finite on all ways if it is on these: on others it is a constant."""
        own = {way for part, way in self.parts[number] if way and part in self.constants}
        return _ALWAYS in _merged(ways | own)


def _merged(ways: set[Way]) -> set[Way]:
    """What holds whether a condition does or not does not depend on it."""
    while _ALWAYS not in ways:
        wider = {way - {each} for way in ways for each in way if _other(way, each) in ways}
        if wider <= ways:
            return ways
        ways = ways | wider
    return {_ALWAYS}


def _other(way: Way, condition: tuple[Hashable, bool]) -> Way:
    return (way - {condition}) | {(condition[0], not condition[1])}


def _narrowed(ways: set[Way], condition: Way) -> Iterator[Way]:
    """Ways under one more condition: those that can be, and are not too narrow to follow."""
    for way in ways:
        possible = not any(_other(condition, each) <= way for each in condition)
        if possible and len(way | condition) <= _DEEPEST:
            yield way | condition
