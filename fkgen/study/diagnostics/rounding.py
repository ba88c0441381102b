"""Would float do: a bound on what rounding adds to the estimate of a filter in its steady state.

Running error analysis of the generated program (Higham 2002, *Accuracy and Stability of Numerical
Algorithms*, sec. 3.3): every number carries a bound on the distance between what the program
computes in float and what exact arithmetic would give. Of the program's statements, not of the
equations they come from.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Self

import numpy as np

from fkgen.backend.execute import Machine
from fkgen.backend.ir import CProgram, Operator
from fkgen.backend.lower import lower
from fkgen.families import family
from fkgen.problem import Code
from fkgen.study.diagnostics.findings import Examination
from fkgen.study.diagnostics.model_numbers import Array, ModelNumbers, SteadyFilter
from fkgen.study.diagnostics.visibility import ON_THE_CIRCLE
from fkgen.symbolic.interface import Status
from fkgen.symbolic.packing import triangle

#: Samples over which errors add up; a filter that forgets more slowly gets no bound.
_LONGEST = 20_000
#: What remains of an error after which its share is left out.
_FORGOTTEN = 1e-6
#: Share of a standard deviation that rounding may take without anybody noticing.
_SMALL = 0.1
#: Half a unit in the last place of float; what its elementary functions err by.
UNIT = 2.0**-24
_FUNCTION = 4.0 * UNIT
#: Relative errors beyond this say that there are no digits left.
_HOPELESS = 0.5


def float_suitability(model: Examination) -> None:
    """Bound the rounding of float in x(k|k) and hold it against its standard deviation.

    Local bounds come from the statements of one step, near rest and at the far end of the range of
    x; the closed loop forgets them as it forgets any error, so their sum is over |F^k| with
    F = A - K C. To first order: an error of the gain acts on an innovation of three standard
    deviations.
    """
    steady = model.steady
    if steady is None or not model.spec.filter.traits.linear:
        return
    bound = _filtered_bound(model, steady)
    if bound is None:
        return
    names = model.states
    deviation = np.sqrt(np.maximum(np.diag(steady.filtered), 0.0))
    model.values |= {f"float_error_bound.{n}": float(b) for n, b in zip(names, bound, strict=True)}
    shares = np.divide(bound, deviation, out=np.full_like(bound, np.inf), where=deviation > 0.0)
    worst = int(np.argmax(shares))
    share = float(shares[worst])
    model.values["float_error_to_sd"] = share
    size = f"{bound[worst]:.2g} {model.spec.model.states[worst].unit}".rstrip()
    text = (
        f"float rounds {names[worst]} by at most {size}, {share:.2g} of its sd at rest, "
        f"for states of the usual range (here up to {usual_range(model)[worst]:.3g})"
    )
    if not np.isfinite(share):
        text = f"no bound on what float rounds in {names[worst]}: no digits are certain"
    code = "float_rounding.used" if model.is_float else "float_rounding"
    model.add("float_suitable" if share <= _SMALL else code, share, bound=text)


def _filtered_bound(model: ModelNumbers, steady: SteadyFilter) -> Array | None:
    """Bound on the rounding of x(k|k), (n,); None if the filter forgets too slowly.

    Two passes over one step: the first bounds the rounding of P, which the closed loop adds up;
    the second that of x, with a P that is off by that sum.
    """
    F, samples = model.A - steady.gain @ model.C, 2
    if steady.radius > 0.0:
        samples += math.ceil(math.log(_FORGOTTEN) / math.log(steady.radius))
    if samples > _LONGEST:
        return None
    spec = replace(model.spec, code=Code("float", model.spec.code.update))
    program = lower(family(spec.filter.family).build(spec))
    local = _local(program, model, steady, np.zeros_like(steady.predicted))
    if local is None:
        return None
    covariance = np.zeros_like(steady.predicted)
    memory, power = np.zeros_like(F), np.eye(len(F))
    for _ in range(samples):
        size = np.abs(power)
        covariance += size @ local["predicted_covariance"] @ size.T
        memory += size
        power = F @ power
    local = _local(program, model, steady, covariance)
    if local is None:
        return None
    kept = np.abs(np.eye(len(F)) - steady.filtered_gain @ model.C)
    return np.asarray(local["filtered_state"] + kept @ (memory @ local["predicted_state"]))


def usual_range(model: ModelNumbers) -> Array:
    """How far from zero each state gets, (n,): 3 standard deviations of the prior from x0.

    Where the plant is stable, at least as far as it gets by itself, driven by inputs of 1.
    """
    from scipy.linalg import solve_discrete_lyapunov  # noqa: PLC0415 - slow to import

    prior = np.abs(model.system.x0) + 3.0 * np.sqrt(np.diag(model.P0).clip(0.0))
    if model.spectral_radius >= 1.0 - ON_THE_CIRCLE:
        return np.asarray(prior)
    variance = np.diag(solve_discrete_lyapunov(model.A, model.Q))
    size = np.abs(np.linalg.solve(np.eye(len(model.A)) - model.A, model.B)).sum(axis=1)
    return np.asarray(np.maximum(prior, size + 3.0 * np.sqrt(variance.clip(0.0))))


def _local(
    program: CProgram, model: ModelNumbers, steady: SteadyFilter, off: Array
) -> dict[str, Array] | None:
    """Bounds on every member of the instance after one step from rest, with P off by ``off``.

    Covariances are full, other members packed as in C; None if the sample would be refused.
    """
    x, u = usual_range(model), np.ones(model.spec.model.nu)
    y = model.C @ x + model.D @ u + 3.0 * np.sqrt(np.diag(steady.innovation).clip(0.0))
    places = list(triangle(len(x)))
    machine = Machine(program)
    machine.use(Bounded.stored, _elementary, ARITHMETIC)
    machine.ports["predicted_state"] = [Bounded.stored(float(v)) for v in x]
    machine.ports["predicted_covariance"] = [
        Bounded.of(float(steady.predicted[i, j]), float(off[i, j])) for i, j in places
    ]
    if machine.step(u.tolist(), y.tolist(), model.spec.defaults) is not Status.OK:
        return None
    errors = {name: np.array([v.error for v in values]) for name, values in machine.ports.items()}
    full = np.zeros_like(steady.predicted)
    for (i, j), error in zip(places, errors["predicted_covariance"], strict=True):
        full[i, j] = full[j, i] = error
    return {**errors, "predicted_covariance": full}


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


ARITHMETIC: Mapping[Operator, Callable[..., Bounded]] = {
    Operator.ADD: lambda a, b: _rounded(float(a) + float(b), a.error + b.error),
    Operator.SUB: lambda a, b: _rounded(float(a) - float(b), a.error + b.error),
    Operator.MUL: _product,
    Operator.DIV: _quotient,
    Operator.NEG: lambda a: Bounded.of(-float(a), a.error),
    Operator.ABS: lambda a: Bounded.of(abs(float(a)), a.error),
    Operator.MAX: lambda a, b: Bounded.of(max(float(a), float(b)), max(a.error, b.error)),
    Operator.MIN: lambda a, b: Bounded.of(min(float(a), float(b)), max(a.error, b.error)),
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
