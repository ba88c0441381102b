"""The plant of a spec as CasADi matrices: constants stay constants, zeros stay structural."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from fkgen.errors import InternalError
from fkgen.faults.chain import LETTERS, Mode
from fkgen.problem import Expression, Matrix, Name, Number, Operation, Spec
from fkgen.problem.covariance import is_singular
from fkgen.problem.text.discretise import OF_TIME, Continuous
from fkgen.problem.text.expression import COMPARISONS, FUNCTIONS, Computed
from fkgen.problem.text.lookup import Table
from fkgen.symbolic.discretise import discretised, doublings

#: Variances of which four may be multiplied, with some room for those that follow from them.
TAME = 1e-60, 1e60


@dataclass(frozen=True, slots=True, kw_only=True)
class Plant:
    """x[k+1] = A x + B g u + c + v, y = C x + D g u + d + w, with Cov(v) = Q and Cov(w) = R."""

    parameters: Mapping[str, ca.SX]  # Symbols of the run-time parameters
    A: ca.SX  # A, B, C, D, Q, R: (n, n), (n, q), (p, n), (p, q), (n, n), (p, p)
    B: ca.SX
    C: ca.SX
    D: ca.SX
    Q: ca.SX
    R: ca.SX
    c: ca.SX  # (n, 1), (p, 1), known offsets
    d: ca.SX
    S: ca.SX  # (n, p), covariance of the noise of x with that of y
    limits: tuple[ca.SX, ...] = ()  # What must not be negative where A, B, c and Q are computed
    rows: tuple[str, ...]  # Names of the rows of y, for headings in the C code
    scalar: str  # Of the C code, for tolerances
    shows_variance: bool  # The covariance of the innovation is shown
    #: R is singular: rows of y may be exact, so a rank decision is needed when conditioning
    noise_free: bool
    #: Variances follow parameters or are so large or small that products of some overflow
    wide: bool

    @property
    def nx(self) -> int:
        """Number of states n."""
        return int(self.A.shape[0])

    @property
    def nu(self) -> int:
        """Number of inputs q."""
        return int(self.B.shape[1])

    @property
    def ny(self) -> int:
        """Number of measurements p."""
        return int(self.C.shape[0])


def plant_of(spec: Spec) -> Plant:
    """Lift the matrices of a spec to CasADi."""
    parameters, model = {p.name: ca.SX.sym(p.name) for p in spec.parameters}, spec.model
    wholes = Wholes(spec, parameters)
    return Plant(
        parameters=parameters,
        **{letter: lift(getattr(model, letter), parameters, wholes) for letter in (*LETTERS, "S")},
        limits=tuple(wholes.limits),
        rows=tuple(signal.name for signal in model.outputs),
        scalar=spec.code.scalar,
        shows_variance=spec.code.shows("innovation_covariance"),
        noise_free=_is_noise_free(model.R),
        wide=_is_wide(model.R) or _is_wide(model.P0),
    )


def mode_plants(spec: Spec, modes: Sequence[Mode]) -> tuple[Plant, ...]:
    """Lift modes of a spec to CasADi: one set of parameters, and equal matrices are one object."""
    base = plant_of(spec)
    wholes = Wholes(spec, base.parameters)
    known: dict[tuple[str, Matrix], ca.SX] = {}
    plants = []
    for mode in modes:
        lifted: dict[str, Any] = {}
        for letter in LETTERS:
            key = letter, getattr(mode, letter)
            if key not in known:
                known[key] = lift(key[1], base.parameters, wholes)
            lifted[letter] = known[key]
        wide = base.wide or _is_wide(mode.R)
        plants.append(replace(base, noise_free=_is_noise_free(mode.R), wide=wide, **lifted))
    return tuple(replace(plant, limits=tuple(wholes.limits)) for plant in plants)


def _is_noise_free(R: Matrix) -> bool:
    """Whether a constant R is singular."""
    return R.is_constant and is_singular(R.values())


def _is_wide(covariance: Matrix) -> bool:
    """Whether variances may be beyond what products of four of them can hold in double."""
    if not covariance.is_constant:
        return True
    variances = np.diag(covariance.values())
    return any(not TAME[0] <= value <= TAME[1] for value in variances[variances > 0.0])


class Wholes:
    """Matrices that are computed as a whole, each once, and what must not be negative for them."""

    def __init__(self, spec: Spec, parameters: Mapping[str, ca.SX]) -> None:
        self.spec, self.parameters = spec, parameters
        self.limits: list[ca.SX] = []
        self._known: dict[Continuous, dict[str, ca.SX]] = {}

    def entry(self, entry: Computed) -> ca.SX:
        """One entry of one of them."""
        source = entry.whole
        if not isinstance(source, Continuous):
            raise InternalError(f"no expression: {entry!r}")
        if source not in self._known:
            matrices = {x: lift(getattr(source, x), self.parameters) for x in OF_TIME}
            T = lift_expression(source.T, self.parameters)
            count = doublings(self.spec, source)
            self._known[source], limits = discretised(source, matrices, T, count)
            self.limits += limits
        return self._known[source][entry.letter][entry.row, entry.column]


def lift(matrix: Matrix, parameters: Mapping[str, ca.SX], wholes: Wholes | None = None) -> ca.SX:
    """A matrix of expressions as SX; entries that are zero are not stored."""
    result = ca.SX(*matrix.shape)
    for i, row in enumerate(matrix.rows):
        for j, entry in enumerate(row):
            if entry != Number(0.0):
                result[i, j] = lift_expression(entry, parameters, wholes)
    return result


def lift_expression(  # noqa: PLR0911 - one per node
    expression: Expression, parameters: Mapping[str, ca.SX], wholes: Wholes | None = None
) -> ca.SX:
    """One expression of a spec as SX."""
    match expression:
        case Number(value):
            return ca.SX(value)
        case Name(identifier):
            return parameters[identifier]
        case Operation("interp", (argument,), Table() as table):
            return _looked_up(table, lift_expression(argument, parameters))
        case Operation("if", (condition, first, second)):
            a, b = (lift_expression(each, parameters) for each in (first, second))
            holds, fails = _alternatives(condition, parameters)
            return _where(holds, a) + _where(fails, b)
        case Operation(symbol, _) if symbol in COMPARISONS:
            return _alternatives(expression, parameters)[0]
        case Operation(symbol, arguments):
            return _OPERATIONS[symbol](*(lift_expression(a, parameters, wholes) for a in arguments))
        case Computed() if wholes is not None:
            return wholes.entry(expression)
    raise InternalError(f"no expression: {expression!r}")


def _where(condition: ca.SX, value: ca.SX) -> ca.SX:
    """The value where a condition holds (is 1), else 0: nothing of a value that may be NaN."""
    return ca.SX.binary(ca.OP_IF_ELSE_ZERO, condition, value)


def _alternatives(condition: Expression, parameters: Mapping[str, ca.SX]) -> tuple[ca.SX, ca.SX]:
    """Whether a condition holds and whether it does not, each 1 or 0."""
    symbol: str = "!="
    sides: tuple[Expression, ...] = condition, Number(0.0)
    if isinstance(condition, Operation) and condition.operator in COMPARISONS:
        symbol, sides = condition.operator, condition.arguments
    a, b = (lift_expression(side, parameters) for side in sides)
    if symbol in {"==", "!="}:
        pair = _where(a <= b, b <= a), (a < b) + (b < a)
        return pair if symbol == "==" else pair[::-1]
    if symbol in {">", "<="}:
        a, b, symbol = b, a, "<" if symbol == ">" else ">="
    return (a < b, b <= a) if symbol == "<" else (b <= a, a < b)


def _looked_up(table: Table, at: ca.SX) -> ca.SX:
    """A table at one place: the piece of the interval, or the end that holds."""
    result = _where(at < table.x[0], ca.SX(table.y[0]))
    for start, end, y, piece in zip(table.x, table.x[1:], table.y, table.pieces, strict=False):
        t, value = at - start, ca.SX(0)
        for coefficient in reversed(piece):
            value = (value + coefficient) * t
        result += _where(start <= at, _where(at < end, y + value))
    return result + _where(table.x[-1] <= at, ca.SX(table.y[-1]))


def _power(base: ca.SX, exponent: ca.SX) -> ca.SX:
    """Products for whole exponents, a square root for halves, exp(b log a) otherwise."""
    value = float(exponent) if exponent.is_constant() else math.nan
    if value == 0.5:
        return ca.sqrt(base)
    if not value.is_integer() or abs(value) > 64:
        return ca.exp(exponent * ca.log(base))
    result, square, remaining = ca.SX(1), base, int(abs(value))
    while remaining:
        if remaining % 2:
            result = result * square
        square, remaining = square * square, remaining // 2
    return 1 / result if value < 0 else result


_OPERATIONS: dict[str, Callable[..., ca.SX]] = {
    **{name: getattr(ca, name) for name in FUNCTIONS if hasattr(ca, name)},
    "abs": ca.fabs,
    "min": ca.fmin,
    "max": ca.fmax,
    "sign": lambda value: (value > 0) - (value < 0),
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "neg": operator.neg,
    "**": _power,
}
