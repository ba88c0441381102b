"""Where a spec has a meaning: parameters in their ranges, and no NaN that a decision would hide."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import casadi as ca

from fkgen.faults.sensor import LARGEST_FACTOR
from fkgen.problem import Expression, Matrix, Name, Number, Spec
from fkgen.problem.text.expression import decisive
from fkgen.symbolic.interface import Kind
from fkgen.symbolic.lifting.expressions import lift, lift_expression
from fkgen.symbolic.linalg import total

#: How far below 0 a computed probability may be, and from 1 the sum of all.
ROUNDED = {"double": 1e-12, "float": 1e-6}
SUMMED = {"double": 1e-9, "float": 1e-5}


def demands(
    spec: Spec, parameters: Mapping[str, ca.SX], *, starting: bool = False
) -> dict[Kind, list[ca.SX]]:
    """What has to hold of run-time parameters, each a value and of what kind it must be.

    A comparison with NaN is false, and the branch that it takes has a value like any other; so
    what expressions decide by is demanded to be finite. Where a filter starts it is that of the
    prior and of the first law.
    """
    every = spec.start_expressions if starting else spec.expressions
    asked = dict.fromkeys(each for whole in every for each in decisive(whole))
    inside: list[ca.SX] = []
    positive: list[ca.SX] = []
    for item in spec.parameters:
        symbol = parameters[item.name]
        rooms = (symbol - item.low, item.low), (item.high - symbol, item.high)
        limited = [room for room, limit in rooms if math.isfinite(limit)]
        if len(limited) == len(rooms):  # nothing else is not finite
            asked.pop(Name(item.name), None)
        inside += limited
    own = _of_starts(spec, parameters) if starting else ()
    for value, kind in (*_of_laws(spec, parameters), *own):
        (inside if kind is Kind.NONNEGATIVE else positive).append(value)
    finite = [lift_expression(each, parameters) for each in asked if not isinstance(each, Number)]
    found = {Kind.NONNEGATIVE: inside, Kind.POSITIVE: positive, Kind.FINITE: finite}
    return {kind: values for kind, values in found.items() if values}


def law_of(matrix: Matrix, parameters: Mapping[str, ca.SX]) -> ca.SX:
    """A transition matrix; what is computed is not below zero, where it is so by rounding."""
    law = lift(matrix, parameters)
    for k in range(law.nnz()):
        if not (law.nz[k].is_constant() or law.nz[k].is_leaf()):
            law.nz[k] = ca.fmax(law.nz[k], 0)
    return law


def _of_starts(spec: Spec, parameters: Mapping[str, ca.SX]) -> Iterator[tuple[ca.SX, Kind]]:
    """What makes probabilities of the numbers that sample 0 begins with."""
    for first in spec.faults.firsts:
        yield from _probabilities(spec, first.stated, parameters)


def _of_laws(spec: Spec, parameters: Mapping[str, ca.SX]) -> Iterator[tuple[ca.SX, Kind]]:
    """What makes probabilities of the numbers that depend on parameters."""
    faults, jump = spec.faults, spec.faults.jump
    laws = [found.law for found in (faults.sensor, jump) if found is not None]
    for law in (*laws, None if jump is None else jump.arrivals):
        for row in () if law is None else law.rows:
            yield from _probabilities(spec, row, parameters)
    if jump is not None and jump.rate is not None:
        rate = lift_expression(jump.rate, parameters)
        yield from ((value, Kind.NONNEGATIVE) for value in (rate, 1 - rate))
    if faults.sensor is not None and faults.sensor.factor is not None:
        factor = lift_expression(faults.sensor.factor, parameters)
        yield factor, Kind.POSITIVE
        yield LARGEST_FACTOR - factor, Kind.NONNEGATIVE


def _probabilities(
    spec: Spec, law: tuple[Expression, ...], parameters: Mapping[str, ca.SX]
) -> Iterator[tuple[ca.SX, Kind]]:
    """Numbers that are not below 0 and sum to 1, up to rounding."""
    least, off = ROUNDED[spec.code.scalar], SUMMED[spec.code.scalar]
    entries = [lift_expression(each, parameters) for each in law]
    apart = total(entries) - 1 if entries else ca.SX(0)
    room = [each if each.is_leaf() else each + least for each in entries]
    for value in (*room, off - apart, off + apart):
        if not value.is_constant():
            yield value, Kind.NONNEGATIVE
