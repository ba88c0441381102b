"""Is there noise where the filter needs it, are there digits enough, and would float do.

The last by running error analysis of the generated program (Higham 2002, *Accuracy and Stability of
Numerical Algorithms*, sec. 3.3): every number carries a bound on the distance between what the
program computes in float and what exact arithmetic would give. Of the program's statements, not of
the equations they come from.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Self

import numpy as np

from fkgen.backend.execute import Machine
from fkgen.backend.ir import Operator
from fkgen.backend.lower import lower
from fkgen.estimators.gaussian.estimate import SHORT_FORM_RATIO, prior_to_noise
from fkgen.families import family
from fkgen.oracle.textbook.riccati import constant_input_noise
from fkgen.problem import Code
from fkgen.study.diagnostics.subject import Array, SteadyFilter, Subject, listed, numerical_rank
from fkgen.study.diagnostics.visibility import ON_THE_CIRCLE
from fkgen.symbolic.interface import Status
from fkgen.symbolic.recursion import Recursion

_LOST = {"float": 1e4, "double": 1e13}  # variances not told apart: 1 / eps, three digits to spare
_WHERE = {
    "innovation_rank": " at the prior with u = 0",
    "innovation_rank_driven": " at the prior with u = 1",
    "innovation_rank_stationary": " at rest",
}
_LONGEST = 20_000  # samples over which errors add up: no bound for a filter that forgets later
_FORGOTTEN = 1e-6  # what remains of an error after which its share is left out
_SMALL = 0.1  # share of a standard deviation that rounding may take without anybody noticing
UNIT = 2.0**-24  # half a unit in the last place of float
_FUNCTION = 4.0 * UNIT  # what its elementary functions err by
_HOPELESS = 0.5  # relative errors beyond this say that there are no digits left


def innovation(model: Subject) -> None:
    """Rank of Om = C P C' + R + D N D', at the prior and at rest, without and with inputs."""
    prior, found = model.C @ model.P0 @ model.C.T, {}
    for name, u in (("innovation_rank", 0.0), ("innovation_rank_driven", 1.0)):
        if model.has_faults or not u:
            inputs = np.full(model.spec.model.nu, u)
            found[name] = prior + constant_input_noise(model.system, inputs)[1]
    if model.steady is not None:
        found["innovation_rank_stationary"] = model.steady.innovation
    perfect_measurements(model)
    model.ranks(found, _WHERE)


def perfect_measurements(model: Subject) -> None:
    """Rows of y, or combinations of them, without noise."""
    exact = [name for name, r in zip(model.outputs, np.diag(model.R), strict=True) if r <= 0.0]
    missing = len(model.R) - numerical_rank(model.R)
    if exact:
        model.add("noise_free_output", len(exact), names=listed(exact))
    elif missing:
        model.add("noise_free_output.combined", missing)


def conditioning(model: Subject) -> None:
    """How many digits the covariance update needs, and which form of it is used."""
    spec = model.spec
    form = family(spec.filter.family).build(spec).form
    ratio, scalar = prior_to_noise(spec), spec.code.scalar
    model.values |= dict.fromkeys(("prior_to_noise", "predicted_to_noise"), ratio)
    model.values["joseph_form"] = float(form == "joseph")
    if form == "short" and ratio > _LOST[scalar]:
        severe = model.is_float and ratio > SHORT_FORM_RATIO
        model.add("conditioning.severe" if severe else "conditioning.lost", ratio, scalar=scalar)
    elif ratio > SHORT_FORM_RATIO:
        shown = f"{ratio:.2g}" if math.isfinite(ratio) else "infinite"
        loss = ": the short form would lose that many digits"
        loss = ", which loses that many of the 16 digits" if form == "short" else loss
        model.add("conditioning", ratio, shown=shown, form=form, loss=loss)


def rounding(model: Subject) -> None:
    """Process noise that vanishes in the rounding of the variance it is added to."""
    if model.steady is None:
        return
    eps = float(np.finfo(np.float32 if model.is_float else np.float64).eps)
    Q, P = np.diag(model.Q), np.diag(model.steady.predicted)
    lost = [name for name, q, p in zip(model.states, Q, P, strict=True) if 0.0 < q < eps * p]
    if lost:
        scalar, remedy = model.spec.code.scalar, 'scalar = "double", or ' * model.is_float
        model.add("rounding", len(lost), names=listed(lost), scalar=scalar, remedy=remedy)


def number_range(model: Subject) -> None:
    """Numbers of the model that float cannot hold."""
    limits = np.finfo(np.float32)
    letters = ("Q", "R", "P0", "x0") if model.curved else ("A", "B", "C", "D", "Q", "R", "P0", "x0")
    for letter in letters if model.is_float else ():
        size = np.abs(getattr(model, letter))
        size = size[size != 0.0]
        outside = size[(size > float(limits.max)) | (size < float(limits.tiny))]
        if outside.size:
            model.add("float_range", float(outside[0]), letter=letter)


def float_suitability(model: Subject) -> None:
    """Hold a bound on what float rounds in x(k|k) against its standard deviation."""
    steady = model.steady
    if steady is None or not model.spec.filter.traits.linear:
        return
    if (bound := _filtered_bound(model, steady)) is None:
        return
    names = model.states
    deviation = np.sqrt(np.maximum(np.diag(steady.filtered), 0.0))
    model.put("float_error_bound", names, bound)
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


def _filtered_bound(model: Subject, steady: SteadyFilter) -> Array | None:
    """Bound on the rounding of x(k|k), (n,); None if the filter forgets too slowly.

    Local bounds come from the statements of one step, near rest and at the far end of the range of
    x; the closed loop forgets them as any error, so their sum is over |F^k| with F = A - K C. The
    first pass bounds the rounding of P; the second that of x, with a P that is off by that sum. To
    first order: an error of the gain acts on an innovation of three standard deviations.
    """
    F, samples = model.A - steady.gain @ model.C, 2
    if steady.radius > 0.0:
        samples += math.ceil(math.log(_FORGOTTEN) / math.log(steady.radius))
    if samples > _LONGEST:
        return None
    spec = replace(model.spec, code=Code("float", model.spec.code.update, fma=model.spec.code.fma))
    recursion = family(spec.filter.family).build(spec)
    machine = Machine(lower(recursion))
    powers = [np.eye(len(F))]
    for _ in range(samples - 1):
        powers.append(F @ powers[-1])
    sizes, off = np.abs(powers), np.zeros_like(steady.predicted)
    for _ in range(2):
        local = _local((recursion, machine), model, steady, off)
        if not local:
            return None
        off = (sizes @ local["predicted_covariance"] @ sizes.transpose(0, 2, 1)).sum(axis=0)
    kept = np.abs(np.eye(len(F)) - steady.filtered_gain @ model.C)
    memory = sizes.sum(axis=0) @ local["predicted_state"]
    return np.asarray(local["filtered_state"] + kept @ memory)


def usual_range(model: Subject) -> Array:
    """How far from zero each state gets, (n,): 3 standard deviations of the prior from x0.

    Where the plant is stable, at least as far as it gets by itself, driven by inputs of 1.
    """
    from scipy.linalg import solve_discrete_lyapunov  # noqa: PLC0415 - slow to import

    prior = np.abs(model.x0) + 3.0 * np.sqrt(np.diag(model.P0).clip(0.0))
    if model.spectral_radius >= 1.0 - ON_THE_CIRCLE:
        return np.asarray(prior)
    variance = np.diag(solve_discrete_lyapunov(model.A, model.Q))
    size = np.abs(np.linalg.solve(np.eye(len(model.A)) - model.A, model.B)).sum(axis=1)
    return np.asarray(np.maximum(prior, size + 3.0 * np.sqrt(variance.clip(0.0))))


def _local(
    built: tuple[Recursion, Machine], model: Subject, steady: SteadyFilter, off: Array
) -> dict[str, Array]:
    """Bounds on every port after one step from rest, with P off by ``off``; none if refused."""
    recursion, machine = built
    x, u = usual_range(model), np.ones(model.spec.model.nu)
    y = model.C @ x + model.D @ u + 3.0 * np.sqrt(np.diag(steady.innovation).clip(0.0))
    machine.use(Bounded.stored, _elementary, ARITHMETIC)
    machine.ports["predicted_state"] = [Bounded.stored(value) for value in x.tolist()]
    stored = np.tril_indices(len(x))
    P = zip(steady.predicted[stored].tolist(), off[stored].tolist(), strict=True)
    machine.ports["predicted_covariance"] = [Bounded(*each) for each in P]
    if "predicted_factors" in machine.ports:  # P is off by at most this share of it
        shares = np.diag(off) / np.diag(steady.predicted).clip(np.finfo(float).tiny)
        share = float(shares.max())
        prior = {"P": tuple(steady.predicted[stored].tolist())}
        factors = recursion.begun(model.spec.defaults, prior)["predicted_factors"]
        machine.ports["predicted_factors"] = [Bounded(v, share * abs(v)) for v in factors]
    if machine.step(u.tolist(), y.tolist(), model.spec.defaults) is not Status.OK:
        return {}
    return {
        port.name: np.asarray(port.unpacked([v.error for v in machine.ports[port.name]]), float)
        for port in machine.program.ports
    }


class Bounded(float):
    """A double with a bound on the error that float arithmetic makes in its place."""

    error: float

    def __new__(cls, value: float, error: float) -> Self:
        """A number with this bound."""
        made = super().__new__(cls, value)
        made.error = error
        return made

    @classmethod
    def stored(cls, value: float) -> Self:
        """A number as float stores it; one that is `Bounded` already stays as it is."""
        if isinstance(value, cls):
            return value
        exact = math.isnan(value) or float(np.float32(value)) == value
        return cls(value, 0.0 if exact else UNIT * abs(value))


def _rounded(value: float, error: float) -> Bounded:
    """A result: what came with the arguments, and one rounding."""
    return Bounded(value, error + UNIT * (abs(value) + error))


def _brought(a: Bounded, b: Bounded) -> float:
    """What the errors of two numbers do to their product."""
    return abs(a) * b.error + abs(b) * a.error + a.error * b.error


def _product(a: Bounded, b: Bounded) -> Bounded:
    return _rounded(float(a) * float(b), _brought(a, b))


def _fused(a: Bounded, b: Bounded, c: Bounded) -> Bounded:
    return _rounded(float(a) * float(b) + float(c), _brought(a, b) + c.error)


def _quotient(a: Bounded, b: Bounded) -> Bounded:
    value = float(a) / float(b) if b else math.inf
    if b.error >= _HOPELESS * abs(b):
        return Bounded(value, math.inf)
    return _rounded(value, (a.error + abs(value) * b.error) / (abs(b) - b.error))


def _compared(a: Bounded, b: Bounded, *, holds: bool) -> Bounded:
    """A comparison; where the errors could turn it, either value may come out."""
    return Bounded(float(holds), float(abs(float(a) - float(b)) < a.error + b.error))


def _where(condition: Bounded, value: Bounded) -> Bounded:
    """The value where a condition holds, else 0."""
    error = value.error if float(condition) > 0.0 else 0.0
    if condition.error > 0.0:
        error = abs(float(value)) + value.error
    return Bounded(float(value) if float(condition) > 0.0 else 0.0, error)


ARITHMETIC: Mapping[Operator, Callable[..., Bounded]] = {
    Operator.ADD: lambda a, b: _rounded(float(a) + float(b), a.error + b.error),
    Operator.SUB: lambda a, b: _rounded(float(a) - float(b), a.error + b.error),
    Operator.MUL: _product,
    Operator.DIV: _quotient,
    Operator.FMA: _fused,
    Operator.FMS: lambda a, b, c: _fused(a, b, Bounded(-float(c), c.error)),
    Operator.FNMA: lambda a, b, c: _fused(Bounded(-float(a), a.error), b, c),
    Operator.NEG: lambda a: Bounded(-float(a), a.error),
    Operator.ABS: lambda a: Bounded(abs(float(a)), a.error),
    Operator.MAX: lambda a, b: Bounded(max(float(a), float(b)), max(a.error, b.error)),
    Operator.MIN: lambda a, b: Bounded(min(float(a), float(b)), max(a.error, b.error)),
    Operator.LT: lambda a, b: _compared(a, b, holds=float(a) < float(b)),
    Operator.LE: lambda a, b: _compared(a, b, holds=float(a) <= float(b)),
    Operator.IF_ELSE_ZERO: _where,
}


def _elementary(operator: Operator, arguments: list[Bounded]) -> Bounded:
    """A function: its own error, and the largest slope times that of the arguments."""
    values = [float(argument) for argument in arguments]
    error = max(argument.error for argument in arguments)
    try:
        value = float(getattr(math, operator.value)(*values))
    except (ValueError, OverflowError):
        return Bounded(math.nan, math.inf)
    moved = error * _slope(operator, values, value, error) if error else 0.0
    return Bounded(value, moved + _FUNCTION * max(abs(value), UNIT))


def _slope(operator: Operator, values: list[float], value: float, error: float) -> float:
    """Largest slope of a function within the bound around its arguments; 1 at most if unlisted."""
    least, far = values[0] - error, math.hypot(*values) - 2.0 * error
    inside = 1.0 - (abs(values[0]) + error) ** 2
    steep = math.cos(values[0]) ** 2 - 2.0 * error if operator is Operator.TAN else 1.0
    slopes = {
        Operator.EXP: abs(value) * math.exp(error) if error < 1.0 else math.inf,
        Operator.LOG: 1.0 / least if least > 0.0 else math.inf,
        Operator.SQRT: 0.5 / math.sqrt(least) if least > 0.0 else math.inf,
        Operator.TAN: 1.0 / steep if steep > 0.0 else math.inf,
        Operator.ATAN2: 2.0 / far if far > 0.0 else math.inf,
        Operator.ASIN: (edge := 1.0 / math.sqrt(inside) if inside > 0.0 else math.inf),
        Operator.ACOS: edge,
        Operator.SINH: (grown := math.hypot(1.0, value) * math.exp(min(error, 100.0))),
        Operator.COSH: grown,
        Operator.HYPOT: 2.0,
    }
    return slopes.get(operator, 1.0)
