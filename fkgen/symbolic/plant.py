"""The plant of a spec as CasADi matrices: constants stay constants, zeros stay structural."""

from __future__ import annotations

import math
import operator as arithmetic
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca

from fkgen.errors import InternalError
from fkgen.faults.chain import LETTERS, Mode
from fkgen.problem import Expression, Matrix, Name, Number, Operation, Spec
from fkgen.problem.covariance import is_singular

_ARITHMETIC: dict[str, Callable[..., ca.SX]] = {
    "+": arithmetic.add,
    "-": arithmetic.sub,
    "*": arithmetic.mul,
    "/": arithmetic.truediv,
    "neg": arithmetic.neg,
}

_FUNCTIONS: dict[str, Callable[..., ca.SX]] = {
    "exp": ca.exp,
    "log": ca.log,
    "sqrt": ca.sqrt,
    "sin": ca.sin,
    "cos": ca.cos,
    "tan": ca.tan,
    "atan2": ca.atan2,
    "abs": ca.fabs,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Plant:
    """x[k+1] = A x + B g u + c + v, y = C x + D g u + w, with Cov(v) = Q and Cov(w) = R."""

    parameters: Mapping[str, ca.SX]  # Symbols of the run-time parameters
    A: ca.SX  # A, B, C, D, Q, R: (n, n), (n, q), (p, n), (p, q), (n, n), (p, p)
    B: ca.SX
    C: ca.SX
    D: ca.SX
    Q: ca.SX
    R: ca.SX
    c: ca.SX  # (n, 1), a known offset: nothing but in modes of jump faults
    rows: tuple[str, ...]  # Names of the rows of y, for headings in the C code
    #: R is singular: rows of y may be exact, so a rank decision is needed when conditioning
    noise_free: bool

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
    parameters = {p.name: ca.SX.sym(p.name) for p in spec.parameters}
    model = spec.model
    lifted = {
        letter: lift(getattr(model, letter), parameters)
        for letter in ("A", "B", "C", "D", "Q", "R")
    }
    rows = tuple(signal.name for signal in model.outputs)
    return Plant(
        parameters=parameters,
        **lifted,
        c=ca.SX(model.nx, 1),
        rows=rows,
        noise_free=is_noise_free(spec),
    )


def mode_plants(spec: Spec, modes: Sequence[Mode]) -> tuple[Plant, ...]:
    """Lift modes of a spec to CasADi: one set of parameters, and equal matrices are one object."""
    base = plant_of(spec)
    known: dict[tuple[str, Matrix], ca.SX] = {}
    plants = []
    for mode in modes:
        lifted: dict[str, Any] = {}
        for letter in LETTERS:
            key = letter, getattr(mode, letter)
            if key not in known:
                known[key] = lift(key[1], base.parameters)
            lifted[letter] = known[key]
        exact = mode.R.is_constant and is_singular(mode.R.values())
        plants.append(replace(base, noise_free=exact, **lifted))
    return tuple(plants)


def is_noise_free(spec: Spec) -> bool:
    """Whether a constant R is singular."""
    return spec.model.R.is_constant and is_singular(spec.model.R.values())


def lift(matrix: Matrix, parameters: Mapping[str, ca.SX]) -> ca.SX:
    """A matrix of expressions as SX; entries that are zero are not stored."""
    rows, columns = matrix.shape
    result = ca.SX(rows, columns)
    for i in range(rows):
        for j in range(columns):
            entry = matrix.rows[i][j]
            if entry != Number(0.0):
                result[i, j] = lift_expression(entry, parameters)
    return result


def lift_expression(expression: Expression, parameters: Mapping[str, ca.SX]) -> ca.SX:
    """One expression of a spec as SX."""
    match expression:
        case Number(value):
            return ca.SX(value)
        case Name(identifier):
            return parameters[identifier]
        case Operation(operator, arguments):
            return _apply(operator, [lift_expression(a, parameters) for a in arguments])
    raise InternalError(f"no expression: {expression!r}")


def _apply(operator: str, arguments: list[ca.SX]) -> ca.SX:
    operations: dict[str, Callable[..., ca.SX]] = {**_ARITHMETIC, **_FUNCTIONS, "**": _power}
    return operations[operator](*arguments)


def _power(base: ca.SX, exponent: ca.SX) -> ca.SX:
    """Products for whole exponents, a square root for halves, exp(b log a) otherwise."""
    if not exponent.is_constant():
        return ca.exp(exponent * ca.log(base))
    value = float(exponent)
    if value == 0.5:
        return ca.sqrt(base)
    if value != math.floor(value) or abs(value) > 64:
        return ca.exp(exponent * ca.log(base))
    result, square, remaining = ca.SX(1), base, int(abs(value))
    while remaining:
        if remaining % 2:
            result = result * square
        square, remaining = square * square, remaining // 2
    return 1 / result if value < 0 else result
