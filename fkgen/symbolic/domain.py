"""Where a spec has a meaning: parameters in their ranges, and no NaN that a decision would hide."""

from __future__ import annotations

import math
from collections.abc import Mapping

import casadi as ca

from fkgen.problem import Name, Number, Spec
from fkgen.problem.text.expression import decisive
from fkgen.symbolic.interface import Kind
from fkgen.symbolic.plant import lift_expression


def demands(spec: Spec, parameters: Mapping[str, ca.SX]) -> dict[Kind, list[ca.SX]]:
    """What has to hold of run-time parameters, each a value and of what kind it must be.

    A comparison with NaN is false, and the branch that it takes has a value like any other; so
    what expressions decide by is demanded to be finite.
    """
    asked = dict.fromkeys(each for whole in spec.expressions for each in decisive(whole))
    inside: list[ca.SX] = []
    for item in spec.parameters:
        symbol = parameters[item.name]
        rooms = (symbol - item.low, item.low), (item.high - symbol, item.high)
        limited = [room for room, limit in rooms if math.isfinite(limit)]
        if len(limited) == len(rooms):  # nothing else is not finite
            asked.pop(Name(item.name), None)
        inside += limited
    finite = [lift_expression(each, parameters) for each in asked if not isinstance(each, Number)]
    found = {Kind.NONNEGATIVE: inside, Kind.FINITE: finite}
    return {kind: values for kind, values in found.items() if values}
