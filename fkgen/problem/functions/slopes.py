"""Numbers that carry their derivatives along, to see where one of those is not finite.

They are compared with nothing, so that they are good for this question alone. CasADi, which knows
the derivatives, is not there when a spec is read, nor when a filter comes from the cache.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fkgen.problem.equations import ARRAYS, Arithmetic
from fkgen.problem.text.expression import COMPARISONS
from fkgen.problem.text.lookup import Table


@dataclass(frozen=True, slots=True)
class Carried:
    """A number and its derivatives; those that are None are zero whatever the number is."""

    value: float
    slope: tuple[float | None, ...]


def seeded(x: Sequence[float], w: Sequence[float]) -> tuple[list[Carried], list[Carried]]:
    """States and noises as what derivatives are taken by."""
    count = len(x) + len(w)
    found = [
        Carried(value, tuple(1.0 if i == at else None for i in range(count)))
        for at, value in enumerate((*x, *w))
    ]
    return found[: len(x)], found[len(x) :]


def carried(number: Any) -> Carried:
    """A number as one that carries its derivatives; a plain one has none."""
    return number if isinstance(number, Carried) else Carried(float(number), ())


def _chained(value: float, parts: Sequence[tuple[float, Carried]]) -> Carried:
    """A value whose partial derivatives are given."""
    count = max((len(each.slope) for _, each in parts), default=0)
    slope: list[float | None] = [None] * count
    for partial, each in parts:
        for i, own in enumerate(each.slope):
            if own is not None:
                slope[i] = (slope[i] or 0.0) + partial * own
    return Carried(value, tuple(slope))


#: Derivatives by the arguments and the result.
_PARTIALS: dict[str, Callable[..., tuple[Any, ...]]] = {
    "+": lambda _, __, ___: (1.0, 1.0),
    "-": lambda _, __, ___: (1.0, -1.0),
    "*": lambda a, b, _: (b, a),
    "/": lambda _, b, r: (1.0 / b, -r / b),
    "**": lambda a, b, r: (b * np.float_power(a, b - 1.0), np.log(a) * r),
    "neg": lambda _, __: (-1.0,),
    "exp": lambda _, r: (r,),
    "log": lambda a, _: (1.0 / a,),
    "sqrt": lambda _, r: (0.5 / r,),
    "sin": lambda a, _: (np.cos(a),),
    "cos": lambda a, _: (-np.sin(a),),
    "tan": lambda _, r: (1.0 + r * r,),
    "asin": lambda a, _: (1.0 / np.sqrt(1.0 - a * a),),
    "acos": lambda a, _: (-1.0 / np.sqrt(1.0 - a * a),),
    "sinh": lambda a, _: (np.cosh(a),),
    "cosh": lambda a, _: (np.sinh(a),),
    "tanh": lambda _, r: (1.0 - r * r,),
    "abs": lambda a, _: (np.sign(a),),
    "atan2": lambda a, b, _: (b / (a * a + b * b), -a / (a * a + b * b)),
    "hypot": lambda a, b, r: (a / r, b / r),
    "min": lambda a, b, _: (float(a <= b), float(a > b)),
    "max": lambda a, b, _: (float(a >= b), float(a < b)),
}


def _function(name: str) -> Callable[..., Carried]:
    def compute(*given: Any) -> Carried:
        numbers = [carried(each) for each in given]
        values = [np.float64(each.value) for each in numbers]
        result = ARRAYS[name](*values)
        partials = _PARTIALS[name](*values, result)
        return _chained(result, list(zip(partials, numbers, strict=True)))

    return compute


def _step(name: str) -> Callable[..., Carried]:
    """What is constant but for jumps."""
    return lambda *given: Carried(ARRAYS[name](*(carried(each).value for each in given)), ())


def _looked_up(table: Table, at: Any) -> Carried:
    number = carried(at)
    if math.isnan(number.value):
        return number
    i = max(0, bisect_right(table.x, number.value) - 1)
    held = not table.x[0] <= number.value < table.x[-1]
    slope = 0.0 if held else table.pieces[i][0]  # any finite number will do inside an interval
    return _chained(table.value(number.value), [(slope, number)])


CARRYING: Arithmetic = {
    **{name: _function(name) for name in _PARTIALS},
    **{name: _step(name) for name in (*COMPARISONS, "sign")},
    "if": lambda condition, a, b: carried(a if carried(condition).value else b),
    "interp": _looked_up,
}
