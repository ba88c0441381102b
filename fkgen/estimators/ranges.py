"""Ranges that the spec states of signals: guards in front of a filter, and around its estimates.

A row of y outside of its range counts as missing and is shown as rejected; a state is clamped into
its range, its variance to at most the square of the range's width. A covariance is scaled by a
diagonal matrix from both sides then, so it stays one, and correlations stay what they are, those
with what y tells of beside the state too. Inside
its ranges a filter computes what it computes without them, bit by bit.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import casadi as ca

from fkgen.estimators.gaussian.gate import HALF
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.index import At, Target, name_of, packed
from fkgen.symbolic.interface import OUTSIDE, Outcome, Port, Role, Status, triangle
from fkgen.symbolic.linalg import column
from fkgen.symbolic.ports import shown
from fkgen.symbolic.recursion import (
    CONFINED,
    Loop,
    OfMatrices,
    Part,
    Phase,
    Recursion,
    Triangle,
    Variable,
)

#: Numbers of an array above which they are copied, or scaled, in a loop.
LOOPED = 210

_REJECTED = "rejected"


def confined(recursion: Recursion) -> Recursion:
    """The same filter within the ranges of its spec; itself if there are none."""
    model, ports, outcomes = recursion.spec.model, recursion.ports, recursion.outcomes
    gated = any(port.name == _REJECTED for port in ports)
    rows = tuple(i for i, row in enumerate(model.outputs) if row.range is not None)
    if rows and not gated:
        meaning = "rows of y[k] that were outside of their range"
        ports += (shown(_REJECTED, (model.ny,), meaning, flags=True),)
        outcomes += (Outcome(Status.FAULT_DECLARED, _REJECTED, HALF),)
    estimates = {port.name: port for port in ports if model.ranged and _is_estimate(port)}
    driven = any(each.range is not None for each in model.inputs)
    if recursion.ranged or not (rows or estimates or driven):
        return recursion
    flag: dict[Target, ca.SX] = {}
    if rows and not gated:
        flag[_REJECTED] = ca.SX.sym(_REJECTED, model.ny)

    def kept(phase: Phase, rows: tuple[int, ...] = ()) -> Phase:
        found = _Confinement(recursion, phase, estimates).confined(rows)
        return replace(found, symbols={**found.symbols, **flag})

    start, closing = recursion.start, recursion.closing
    return replace(
        recursion,
        ports=ports,
        outcomes=outcomes,
        ranged=True,
        update=kept(recursion.update, rows),
        predict=kept(recursion.predict),
        closing=closing and kept(closing),
        start=start and replace(start, symbols={**start.symbols, **flag}),
    )


def _is_estimate(port: Port) -> bool:
    """Whether a port is a state, or the covariance of one."""
    return port.unit in {"x", "xx"} and (bool(port.prior) or port.role is Role.OUTPUT)


def _factors_of(covariance: str) -> str:
    """Where the factors of a covariance are, if it has any."""
    return covariance.replace("covariance", "factors")


class _Confinement:
    """One phase: what it wrote to ports goes to locals, and from there to ports, if it may."""

    def __init__(self, recursion: Recursion, phase: Phase, estimates: Mapping[str, Port]) -> None:
        self.model, self.phase, self.estimates = recursion.spec.model, phase, estimates
        self.order, self.beside = recursion.factor_order, recursion.beside
        self.local: dict[str, str] = {}  # of ports that were written so far

    def confined(self, rows: Sequence[int]) -> Phase:
        """The phase; of an update with the ``rows`` of y that have a range."""
        wanted = {*self.estimates, *([_REJECTED] if rows else [])}
        wanted |= {_factors_of(name) for name in self.estimates} if self.order else set()
        wanted |= {self.beside[name][0] for name in self.estimates if name in self.beside}
        blocks = tuple(self._renamed(block, wanted) for block in self.phase.blocks)
        symbols = dict(self.phase.symbols)
        symbols |= {self._read(place): symbol for place, symbol in symbols.items()}
        raw = {local: symbols[local] for local in self.local.values()}
        written = {name: ca.SX.sym(name, raw[local].numel()) for name, local in self.local.items()}
        if rows:
            raw[OUTSIDE] = symbols[OUTSIDE] = ca.SX.sym(OUTSIDE, self.model.ny)
            written[_REJECTED] = ca.SX.sym(_REJECTED, self.model.ny)
        builder = PhaseBuilder(raw | written)
        with builder.titled(CONFINED):
            for name in filter(self.estimates.__contains__, self.local):
                self._confine(builder, self.estimates[name])
            if rows:
                self._reject(builder, rows)
        tail = builder.phase()
        variables = (Variable(local, raw[local].numel()) for local in self.local.values())
        symbols |= {place: s for place, s in tail.symbols.items() if name_of(place) not in written}
        return Phase(
            (*blocks, *tail.blocks),
            (*self.phase.variables, *variables, *tail.variables),
            symbols,
            self.phase.unless,
        )

    def _read(self, place: Target) -> Target:
        """Where to read what stood at a place."""
        local = self.local.get(name_of(place))
        if local is None:
            return place
        return replace(place, name=local) if isinstance(place, At) else local

    def _renamed(self, part: Part, wanted: Collection[str]) -> Part:
        """A part that writes to locals; what reads a port after that reads its local."""
        if isinstance(part, OfMatrices):  # which write to locals
            names = ("source",) if isinstance(part, Triangle) else ("left", "right", "start")
            places: Any = {name: getattr(part, name) for name in names}
            places = {name: self._read(place) for name, place in places.items() if place}
            return replace(part, **places)
        reads = tuple(map(self._read, part.reads))
        if isinstance(part, Loop):
            body = tuple(self._renamed(each, wanted) for each in part.body)
            return replace(part, reads=reads, body=body)
        for name in map(name_of, part.assign):
            if name in wanted:
                self.local.setdefault(name, f"raw_{name}")
        return replace(part, reads=reads, assign={self._read(k): v for k, v in part.assign.items()})

    def _confine(self, builder: PhaseBuilder, port: Port) -> None:
        """One estimate, or one for each mode, or its covariance."""
        local = self.local[port.name]
        raw, size = builder.symbol(local), port.shape[-1]
        if port.symmetric:
            for at in range(port.size // len(triangle(size))):
                self._scale(builder, port.name, at)
            also = _factors_of(port.name), self.beside.get(port.name, ("",))[0]
            for name in (port.name, *filter(self.local.__contains__, also)):
                self._copy(builder, name)
            return
        values = ca.vertsplit(raw)
        for begin in range(0, port.size, size):
            for each in self.model.ranged:
                at = begin + each.at
                values[at] = ca.fmin(ca.fmax(values[at], each.low), each.high)
        builder.assign({port.name: column(values)})

    def _scale(self, builder: PhaseBuilder, name: str, at: int) -> None:
        """Rows and columns of variances that are too large, of the covariance ``at`` of a port.

        And of its factors, if there are any, and of what covariance it has with numbers beside x.
        """
        n, local = self.model.ne, self.local[name]
        begin = at * len(triangle(n))
        for each in self.model.ranged:
            row, most = each.error, (each.high - each.low) ** 2
            own = begin + packed(row, row)
            excess = builder.at(local, own) - most
            scale = builder.local(f"scale_{local}_{own}", 1, initial=1.0)
            with builder.if_positive(excess):
                builder.assign({scale.name(): ca.sqrt(most / builder.at(local, own))})
                self._scale_factors(builder, (name, at), row, scale)
                self._scale_beside(builder, (name, at), row, scale)
                if len(triangle(n)) <= LOOPED:
                    for other in (i for i in range(n) if i != row):
                        place = At(local, begin + packed(max(row, other), min(row, other)))
                        self._times(builder, place, scale)
                else:
                    with builder.loop("j", 0, row) as j:
                        self._times(builder, At(local, begin + packed(row, j)), scale)
                    with builder.loop("j", row + 1, n) as j:
                        self._times(builder, At(local, begin + packed(j, row)), scale)
                builder.assign({At(local, own): ca.SX(most)})

    def _scale_factors(
        self, builder: PhaseBuilder, which: tuple[str, int], row: int, scale: ca.SX
    ) -> None:
        """U and D of the covariance that has one row and its column scaled: S U S^-1 and S D S."""
        factors = self.local.get(_factors_of(which[0]))
        if factors is None:
            return
        at, sizes = self.order.index(row), [self.model.ne + r for r in self._counts(*which)]
        shares = {packed(j, at): scale for j in range(at + 1, sizes[-1])}
        shares |= {packed(at, i): 1 / scale for i in range(at)}
        shares[packed(at, at)] = scale * scale
        begin = sum(len(triangle(size)) for size in sizes[:-1])
        places = {At(factors, begin + k): share for k, share in shares.items()}
        builder.assign({place: builder.read(place) * share for place, share in places.items()})

    def _scale_beside(
        self, builder: PhaseBuilder, which: tuple[str, int], row: int, scale: ca.SX
    ) -> None:
        """Column ``row`` of the covariance of numbers beside x with x."""
        if which[0] not in self.beside:
            return
        name, numbers = self.beside[which[0]]
        local, counts = self.local[name], self._counts(*which)
        width, begin = builder.symbol(local).numel() // sum(numbers), sum(counts[:-1])
        for k in range(begin, begin + counts[-1]):
            self._times(builder, At(local, k * width + row), scale)

    def _counts(self, name: str, at: int) -> tuple[int, ...]:
        """How many numbers are beside x in the covariances of a port, up to this one."""
        return self.beside[name][1][: at + 1] if name in self.beside else (0,) * (at + 1)

    @staticmethod
    def _times(builder: PhaseBuilder, place: At, scale: ca.SX) -> None:
        builder.assign({place: builder.read(place) * scale})

    def _copy(self, builder: PhaseBuilder, name: str) -> None:
        """A covariance to its port, or factors of one."""
        local = self.local[name]
        size = builder.symbol(local).numel()
        if size <= LOOPED:
            builder.assign({name: builder.symbol(local)})
            return
        with builder.loop("i", 0, size) as i:
            builder.assign({At(name, i): builder.at(local, i)})

    def _reject(self, builder: PhaseBuilder, rows: Sequence[int]) -> None:
        """Rows outside of their range beside those that a gate has left out."""
        outside = builder.symbol(OUTSIDE)
        shown = [outside[i] if i in rows else ca.SX(0) for i in range(self.model.ny)]
        if _REJECTED in self.local:
            gate = builder.symbol(self.local[_REJECTED])
            shown = [ca.fmax(gate[i], each) for i, each in enumerate(shown)]
        builder.assign({_REJECTED: column(shown)})
