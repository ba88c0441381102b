"""Running error analysis of a generated program: a bound on its rounding, statement by statement.

Every number carries a bound on the distance between what the program computes in float and what
exact arithmetic would give (Higham 2002, *Accuracy and Stability of Numerical Algorithms*, sec.
3.3). Of the program's statements, not of the equations they come from.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Self

import numpy as np

from fkgen.backend.execute import Machine
from fkgen.backend.ir import CProgram, Operator
from fkgen.symbolic.interface import Status

#: Half a unit in the last place of float; what its elementary functions err by.
UNIT = 2.0**-24
_FUNCTION = 4.0 * UNIT

#: Relative errors beyond this say that there are no digits left.
_HOPELESS = 0.5


class Bounded(float):
    """A double with a bound on the error that float arithmetic makes in its place."""

    error: float

    @classmethod
    def of(cls, value: float, error: float = 0.0) -> Self:
        """A number with this bound."""
        made = cls(value)
        made.error = error
        return made

    @classmethod
    def stored(cls, value: float) -> Self:
        """A number as float stores it; one that is `Bounded` already stays as it is."""
        if isinstance(value, cls):
            return value
        exact = math.isnan(value) or float(np.float32(value)) == value
        return cls.of(value, 0.0 if exact else UNIT * abs(value))


def _rounded(value: float, error: float) -> Bounded:
    """A result: what came with the arguments, and one rounding."""
    return Bounded.of(value, error + UNIT * (abs(value) + error))


def _product(a: Bounded, b: Bounded) -> Bounded:
    error = abs(a) * b.error + abs(b) * a.error + a.error * b.error
    return _rounded(float(a) * float(b), error)


def _quotient(a: Bounded, b: Bounded) -> Bounded:
    value = float(a) / float(b) if b else math.inf
    if b.error >= _HOPELESS * abs(b):
        return Bounded.of(value, math.inf)
    return _rounded(value, (a.error + abs(value) * b.error) / (abs(b) - b.error))


def _larger(a: Bounded, b: Bounded) -> Bounded:
    return Bounded.of(max(float(a), float(b)), max(a.error, b.error))


def _smaller(a: Bounded, b: Bounded) -> Bounded:
    return Bounded.of(min(float(a), float(b)), max(a.error, b.error))


ARITHMETIC: Mapping[Operator, Callable[..., Bounded]] = {
    Operator.ADD: lambda a, b: _rounded(float(a) + float(b), a.error + b.error),
    Operator.SUB: lambda a, b: _rounded(float(a) - float(b), a.error + b.error),
    Operator.MUL: _product,
    Operator.DIV: _quotient,
    Operator.NEG: lambda a: Bounded.of(-float(a), a.error),
    Operator.ABS: lambda a: Bounded.of(abs(float(a)), a.error),
    Operator.MAX: _larger,
    Operator.MIN: _smaller,
}

_PLAIN: Mapping[Operator, Callable[..., float]] = {
    Operator.EXP: math.exp,
    Operator.LOG: math.log,
    Operator.SQRT: math.sqrt,
    Operator.SIN: math.sin,
    Operator.COS: math.cos,
    Operator.TAN: math.tan,
    Operator.ATAN2: math.atan2,
}


def _elementary(operator: Operator, arguments: list[Bounded]) -> Bounded:
    """A function: its own error, and the largest slope times that of the arguments."""
    values = [float(argument) for argument in arguments]
    error = max(argument.error for argument in arguments)
    try:
        value = _PLAIN[operator](*values)
    except (ValueError, OverflowError):
        return Bounded.of(math.nan, math.inf)
    moved = error * _slope(operator, values, value, error) if error else 0.0
    return Bounded.of(value, moved + _FUNCTION * max(abs(value), UNIT))


def _slope(operator: Operator, values: list[float], value: float, error: float) -> float:
    """Largest slope of a function within the bound around its arguments."""
    match operator:
        case Operator.EXP:
            return abs(value) * math.exp(min(error, 1.0)) if error < 1.0 else math.inf
        case Operator.LOG | Operator.SQRT:
            least = values[0] - error
            if least <= 0.0:
                return math.inf
            return 1.0 / least if operator is Operator.LOG else 0.5 / math.sqrt(least)
        case Operator.TAN:
            steep = math.cos(values[0]) ** 2 - 2.0 * error
            return 1.0 / steep if steep > 0.0 else math.inf
        case Operator.ATAN2:
            far = math.hypot(*values) - 2.0 * error
            return 2.0 / far if far > 0.0 else math.inf
    return 1.0


def one_step(
    program: CProgram,
    start: Mapping[str, list[Bounded]],
    sample: tuple[list[float], list[float]],
    parameters: Mapping[str, float],
) -> dict[str, np.ndarray[tuple[int, ...], np.dtype[np.float64]]] | None:
    """Bounds on the rounding of every member of the instance after one step.

    Parameters
    ----------
    program : CProgram
        As lowered for float.
    start : mapping of str to list of Bounded
        Members of the instance before the step, with what they are off already.
    sample : pair of list of float
        u and y.
    parameters : mapping of str to float

    Returns
    -------
    dict of str to ndarray, or None
        Packed as in C; None if the sample would be refused.
    """
    machine = Machine(program)
    machine.use(Bounded.stored, _elementary, ARITHMETIC)
    machine.ports |= {name: list(values) for name, values in start.items()}
    if machine.step(*sample, parameters) is not Status.OK:
        return None
    return {
        name: np.array([value.error for value in values]) for name, values in machine.ports.items()
    }
