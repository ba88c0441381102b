"""Where f, h and their derivatives are not finite, as a filter starts and while it runs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fkgen.problem.equations import Equations
from fkgen.problem.functions.named import Named
from fkgen.problem.functions.slopes import CARRYING, Carried, carried, seeded
from fkgen.problem.functions.vectors import HIDDEN
from fkgen.problem.functions.writing import Row, rows_of, text_of
from fkgen.problem.signals import Signal
from fkgen.problem.table.place import Place, show
from fkgen.problem.text.expression import Expression, Name, Operation, decisive, names, to_text

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Point:
    """Where equations are looked at."""

    x: Sequence[float]
    u: Sequence[float]
    w: Sequence[float]
    parameters: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Fault:
    """What is not finite."""

    key: str  # such as "h.range" or "let.c"
    text: str  # what is written there
    what: str  # such as "a value that is not a number"
    at: str  # the values of what it names, such as "x = 3, y = 0"


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """A look at equations for what is not finite."""

    equations: Equations
    states: Sequence[Signal]
    outputs: Sequence[Signal]
    slopes: bool = True  # Derivatives by states and noises have to be finite too
    #: So has what they decide by, such as both sides of a comparison, and f wherever it is
    #: evaluated within a sample
    running: bool = False
    largest: float = math.inf  # Number beyond which none is finite

    def fault(self, part: str, point: Point) -> Fault | None:
        """The first fault of "f" or of "h": the row, or the definition in which it arises."""
        places: list[Sequence[float]] = [point.x]
        if part == "f" and self.running:
            places.clear()
            given = point.u, point.w, point.parameters
            self.equations.moved(point.x, *given, passed=places.append)
        for x in places:
            at = replace(point, x=x)
            for row in rows_of(self.equations, self.states, self.outputs, part):
                if found := self._of_row(row, at):
                    return found
        return None

    def _of_row(self, row: Row, at: Point) -> Fault | None:
        """What of a row is not finite, or what it decides by."""
        if what := self._not_finite(row.tree, at):
            origin = self._origin(row, at) or row
            return self._told(origin, self._not_finite(origin.tree, at) or what, at)
        for own, tree in self._decisions(row):
            value = self._value(tree, at).value
            if not math.isfinite(value):
                what = f"a decision by {to_text(tree)}, which is {self._shown(value)}"
                return self._told(own, what, at)
        return None

    def _origin(self, row: Row, at: Point) -> Row | None:
        """The definition by which a row is not finite, if it has a name: the first one of all."""
        for name in self._reached(row.tree, at):
            tree = self._let.get(name)
            if tree is None or not self._not_finite(tree, at):
                continue
            own = Row(f"let.{name}", name, tree)
            if found := self._origin(own, at) or (None if HIDDEN.fullmatch(name) else own):
                return found
        return None

    def _reached(self, tree: Expression, at: Point) -> Iterator[str]:
        """The names in a tree, but for branches that are not taken."""
        match tree:
            case Name(identifier):
                yield identifier
            case Operation("if", (condition, first, second)):
                yield from self._reached(condition, at)
                yield from self._reached(first if self._value(condition, at).value else second, at)
            case Operation(_, arguments):
                for each in arguments:
                    yield from self._reached(each, at)

    def _decisions(self, row: Row) -> Iterator[tuple[Row, Expression]]:
        """What a row and the definitions that it needs decide by."""
        if self.running:
            for name in self._needed(row.tree):
                hidden, tree = HIDDEN.fullmatch(name), self._let[name]
                own = row if hidden else Row(f"let.{name}", name, tree)
                yield from ((own, each) for each in decisive(tree))
            yield from ((row, each) for each in decisive(row.tree))

    def _needed(self, tree: Expression) -> list[str]:
        """The definitions that a tree needs, in order."""
        wanted = names(tree)
        for name in reversed(self._let):
            if name in wanted:
                wanted |= names(self._let[name])
        return [name for name in self._let if name in wanted]

    @property
    def _let(self) -> dict[str, Expression]:
        return dict(self.equations.let)

    def _value(self, tree: Expression, at: Point) -> Carried:
        x, w = seeded(at.x, at.w)
        alone = replace(self.equations, f=(tree,))
        return carried(alone.stated(x, at.u, w, at.parameters, CARRYING)[0])

    def _not_finite(self, tree: Expression, at: Point) -> str:
        """What of a tree is not finite."""
        found = self._value(tree, at)
        if not self._fits(found.value):
            return f"a value that is {self._shown(found.value)}"
        variables = [*self.equations.states, *(noise.name for noise in self.equations.noises)]
        slopes = found.slope if self.slopes else ()
        for name, slope in zip(variables, slopes, strict=False):  # constants have none
            if slope is not None and not self._fits(slope):
                return f"a derivative with respect to {name} that is {self._shown(slope)}"
        return ""

    def _fits(self, value: float) -> bool:
        return math.isfinite(value) and abs(value) <= self.largest

    def _shown(self, value: float) -> str:
        if math.isnan(value):
            return "not a number"
        return "infinite" if math.isinf(value) else f"too large ({value:g})"

    def _told(self, row: Row, what: str, at: Point) -> Fault:
        known: dict[str, Any] = dict(zip(self.equations.states, at.x, strict=True))
        known |= dict(zip(self.equations.inputs, at.u, strict=True))
        noises = (noise.name for noise in self.equations.noises)
        known |= {name: w for name, w in zip(noises, at.w, strict=True) if w}
        known |= at.parameters
        trees = [row.tree, *(self._let[name] for name in self._needed(row.tree))]
        used = frozenset().union(*map(names, trees))
        values = ", ".join(f"{name} = {known[name]:g}" for name in known if name in used)
        return Fault(row.key, text_of(row, self.equations), what, values)


def check_start(equations: Equations, named: Named, x0: Array, place: Place) -> None:
    """Refuse an f, an h or a derivative of them that is not finite at x0 and w = 0.

    Inputs are 0, or 1 where 0 will not do.
    """
    look = Look(equations=equations, states=named.states, outputs=named.outputs)
    faults = []
    for u in (0.0, 1.0) if named.inputs else (0.0,):
        inputs, noises = [u] * len(equations.inputs), [0.0] * len(equations.noises)
        point = Point(x0.tolist(), inputs, noises, named.scope)
        faults.append(look.fault("f", point) or look.fault("h", point))
    fault = faults[0]
    if fault is None or None in faults:
        return
    given = f"{show(fault.text)} with {fault.what} at x0 ({fault.at})"
    expected = "finite values and derivatives where the filter starts: another x0, or another form"
    raise place.entry(fault.key).error(given, expected)
