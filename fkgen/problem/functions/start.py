"""Whether equations and their derivatives have values where a filter starts.

Derivatives come from numbers that carry theirs along; they are compared with nothing, so that they
are good for this question alone.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fkgen.problem.equations import ARRAYS, Arithmetic, Equations, trees_of
from fkgen.problem.functions.named import Named
from fkgen.problem.signals import Signal
from fkgen.problem.table.place import Place, show
from fkgen.problem.text.expression import COMPARISONS, Expression, to_text
from fkgen.problem.text.lookup import Table

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Carried:
    """A number and its derivatives; those that are None are zero whatever the number is."""

    value: float
    slope: tuple[float | None, ...]


def check_start(equations: Equations, named: Named, x0: Array, place: Place) -> None:
    """Refuse an f, an h or a derivative of them that is not finite at x0 and w = 0.

    Inputs are 0, or 1 where 0 will not do.
    """
    faults = [_fault(equations, named, x0, u) for u in ((0.0, 1.0) if named.inputs else (0.0,))]
    if None in faults or faults[0] is None:
        return
    key, what, tree = faults[0]
    names = (*equations.states, *equations.inputs)
    values = [*x0.tolist(), *([0.0] * len(named.inputs))]
    at = ", ".join(f"{name} = {value:g}" for name, value in zip(names, values, strict=True))
    given = f"{show(to_text(tree))} with {what} at x0 ({at})"
    expected = "finite values and derivatives where the filter starts: another x0, or another form"
    raise place.entry(key).error(given, expected)


def _fault(
    equations: Equations, named: Named, x0: Array, u: float
) -> tuple[str, str, Expression] | None:
    """The first row that is not finite: its key, what is not, and its tree."""
    variables = [*equations.states, *(noise.name for noise in equations.noises)]
    count = len(variables)
    start = [*x0.tolist(), *([0.0] * (count - len(x0)))]
    seeds = [
        Carried(value, tuple(1.0 if i == at else None for i in range(count)))
        for at, value in enumerate(start)
    ]
    x, w, inputs = seeds[: len(x0)], seeds[len(x0) :], [u] * len(equations.inputs)
    f = equations.stated(x, inputs, w, named.scope, CARRYING)
    h = equations.seen(x, inputs, named.scope, CARRYING)
    motion = [key for each in named.states for key in _keys(each, equations)]
    rows = list(zip(motion, trees_of(equations.f), f, strict=True))
    rows += zip((f"h.{each.name}" for each in named.outputs), equations.h, h, strict=True)
    for key, tree, value in rows:
        if (what := _not_finite(_carried(value), variables)) is not None:
            return key, what, tree
    return None


def _keys(signal: Signal, equations: Equations) -> list[str]:
    """The key of a state, once for each row of f that it has."""
    count = 1
    if signal.manifold:
        count = 3 if equations.states.index(f"{signal.name}[0]") in equations.turning else 4
    return [f"f.{signal.name}"] * count


def _not_finite(found: Carried, variables: Sequence[str]) -> str | None:
    if not math.isfinite(found.value):
        return f"a value that is {_shown(found.value)}"
    for name, slope in zip(variables, found.slope, strict=False):  # constants have none
        if slope is not None and not math.isfinite(slope):
            return f"a derivative with respect to {name} that is {_shown(slope)}"
    return None


def _shown(value: float) -> str:
    return "not a number" if math.isnan(value) else "infinite"


def _carried(number: Any) -> Carried:
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
        numbers = [_carried(each) for each in given]
        values = [np.float64(each.value) for each in numbers]
        result = ARRAYS[name](*values)
        partials = _PARTIALS[name](*values, result)
        return _chained(result, list(zip(partials, numbers, strict=True)))

    return compute


def _step(name: str) -> Callable[..., Carried]:
    """What is constant but for jumps."""
    return lambda *given: Carried(ARRAYS[name](*(_carried(each).value for each in given)), ())


def _looked_up(table: Table, at: Any) -> Carried:
    number = _carried(at)
    i = max(0, bisect_right(table.x, number.value) - 1)
    held = not table.x[0] <= number.value < table.x[-1]
    slope = 0.0 if held else table.pieces[i][0]  # any finite number will do inside an interval
    return _chained(table.value(number.value), [(slope, number)])


CARRYING: Arithmetic = {
    **{name: _function(name) for name in _PARTIALS},
    **{name: _step(name) for name in (*COMPARISONS, "sign")},
    "if": lambda condition, a, b: _carried(a if _carried(condition).value else b),
    "interp": _looked_up,
}
