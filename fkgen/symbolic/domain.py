"""Where a spec has a meaning: parameters in their ranges, and no NaN that a decision would hide."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import casadi as ca

from fkgen.faults.sensor import LARGEST_FACTOR
from fkgen.problem import Matrix, Name, Number, Spec
from fkgen.problem.text.expression import decisive
from fkgen.symbolic.interface import Kind
from fkgen.symbolic.lifting.expressions import lift, lift_expression
from fkgen.symbolic.linalg import total

#: How far below 0 a computed probability may be, and from 1 the sum of all.
ROUNDED = {"double": 1e-12, "float": 1e-6}
SUMMED = {"double": 1e-9, "float": 1e-5}


def demands(spec: Spec, parameters: Mapping[str, ca.SX]) -> dict[Kind, list[ca.SX]]:
    """What has to hold of run-time parameters, each a value and of what kind it must be.

    A comparison with NaN is false, and the branch that it takes has a value like any other; so
    what expressions decide by is demanded to be finite.
    """
    asked = dict.fromkeys(each for whole in spec.expressions for each in decisive(whole))
    inside: list[ca.SX] = []
    positive: list[ca.SX] = []
    for item in spec.parameters:
        symbol = parameters[item.name]
        rooms = (symbol - item.low, item.low), (item.high - symbol, item.high)
        limited = [room for room, limit in rooms if math.isfinite(limit)]
        if len(limited) == len(rooms):  # nothing else is not finite
            asked.pop(Name(item.name), None)
        inside += limited
    for value, kind in _of_laws(spec, parameters):
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


def _of_laws(spec: Spec, parameters: Mapping[str, ca.SX]) -> Iterator[tuple[ca.SX, Kind]]:
    """What makes probabilities of the numbers that depend on parameters."""
    faults, least, off = spec.faults, ROUNDED[spec.code.scalar], SUMMED[spec.code.scalar]
    for found in (faults.sensor, faults.jump):
        for row in found.law.rows if found is not None and found.law is not None else ():
            entries = [lift_expression(each, parameters) for each in row]
            apart = total(entries) - 1
            room = [each if each.is_leaf() else each + least for each in entries]
            for value in (*room, off - apart, off + apart):
                if not value.is_constant():
                    yield value, Kind.NONNEGATIVE
    if faults.jump is not None and faults.jump.rate is not None:
        rate = lift_expression(faults.jump.rate, parameters)
        yield from ((value, Kind.NONNEGATIVE) for value in (rate, 1 - rate))
    if faults.sensor is not None and faults.sensor.factor is not None:
        factor = lift_expression(faults.sensor.factor, parameters)
        yield factor, Kind.POSITIVE
        yield LARGEST_FACTOR - factor, Kind.NONNEGATIVE
