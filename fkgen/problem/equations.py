"""Motion and measurement by equations, where matrices do not do: frozen values and their numbers.

    x[k+1] = f(x, u, w) + additive noise of covariance Q,   y[k] = h(x, u) + v

Vectors and rotations are written out: equations are scalar trees over definitions in order, so
what several of them need is said once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import numpy as np

from fkgen.errors import SpecError
from fkgen.problem.text.expression import (
    Computed,
    Expression,
    Name,
    Number,
    Operation,
    names,
)
from fkgen.problem.text.matrix import Matrix, plain

Integrator = Literal["rk4", "euler"]
#: Operators and functions by name, for numbers of any kind; ``interp`` takes a table first.
Arithmetic = Mapping[str, Callable[..., Any]]
Definition = tuple[str, Expression]

#: Below this square of an angle half an angle over its sine is a series.
SMALL = 1e-6


@dataclass(frozen=True, slots=True)
class Noise:
    """A random number with mean zero that enters through f."""

    name: str
    unit: str
    variance: Expression  # its spectral density where time is continuous


@dataclass(frozen=True, slots=True)
class Increment:
    """How four numbers, a unit quaternion (w, x, y, z), move: q * exp(by), a rotation vector.

    Where time is continuous, ``by`` is the body rate.
    """

    at: int  # of its first number in the state vector
    by: tuple[Expression, Expression, Expression]


Motion = Expression | Increment


@dataclass(frozen=True, slots=True, kw_only=True)
class Equations:
    """f and h of a plant."""

    #: states, inputs: what the numbers of x and u are called in the trees; the four of an
    #: attitude q are "q[0]" to "q[3]"
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    noises: tuple[Noise, ...] = ()
    let: tuple[Definition, ...] = ()  # each may name those before it
    #: By component of x; an `Increment` stands for four of them. dx/dt where time is continuous
    f: tuple[Motion, ...]
    h: tuple[Expression, ...]  # by row of y
    attitudes: tuple[int, ...] = ()  # where unit quaternions begin in x
    continuous: bool = False
    integrator: Integrator = "rk4"
    substeps: int = 1
    period: Expression | None = None  # from sample to sample, where time is continuous
    #: What was given as a text, by its key, such as ("h.range", "hypot(x, y)"); for readers alone
    written: tuple[tuple[str, str], ...] = field(default=(), compare=False)
    apart: ClassVar[bool] = True  # its trees name states, so they are no expressions of a spec

    @property
    def names(self) -> frozenset[str]:
        """The parameters that they depend on."""
        trees = [*self.trees, *(noise.variance for noise in self.noises)]
        trees += [] if self.period is None else [self.period]
        own = {*self.states, *self.inputs, *(noise.name for noise in self.noises)}
        return frozenset().union(*map(names, trees)) - own - {name for name, _ in self.let}

    @property
    def trees(self) -> Iterator[Expression]:
        """Every tree of them."""
        yield from (tree for _, tree in self.let)
        yield from trees_of(self.f)
        yield from self.h

    @property
    def turning(self) -> frozenset[int]:
        """Where the attitudes begin in x that f turns by an increment."""
        return frozenset(each.at for each in self.f if isinstance(each, Increment))

    @property
    def plain_let(self) -> list[tuple[str, object]]:
        """The definitions, as a spec file writes them."""
        return [(name, plain(tree)) for name, tree in self.let]

    @property
    def motion(self) -> tuple[Any, ...]:
        """What f is, to be compared."""
        timing = (self.continuous, self.integrator, self.substeps, self.period)
        return self.f, self.for_f, self.noises, timing

    @property
    def for_f(self) -> tuple[Definition, ...]:
        """The definitions that f needs."""
        return needed(self.let, trees_of(self.f))

    @property
    def for_h(self) -> tuple[Definition, ...]:
        """The definitions that h needs."""
        return needed(self.let, self.h)

    def said(self, key: str) -> tuple[object, ...]:
        """All that is said about "f" or about "h"; equal where it is the same."""
        return (self.for_f, self.f) if key == "f" else (self.for_h, self.h)

    def evaluate(
        self,
        x: Sequence[Any],
        u: Sequence[Any],
        w: Sequence[Any],
        parameters: Mapping[str, Any],
    ) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        """The next state without its additive noise, and the measurement without noise.

        Numbers may be arrays of one shape. What has no value is NaN or infinite.
        """
        return self.moved(x, u, w, parameters), self.seen(x, u, parameters)

    def seen(
        self,
        x: Sequence[Any],
        u: Sequence[Any],
        parameters: Mapping[str, Any],
        arithmetic: Arithmetic | None = None,
    ) -> tuple[Any, ...]:
        """The measurement, h(x, u)."""
        values = dict(parameters) | self._named(x, u)
        return _values(self.for_h, self.h, values, arithmetic or ARRAYS)

    def stated(
        self,
        x: Sequence[Any],
        u: Sequence[Any],
        w: Sequence[Any],
        parameters: Mapping[str, Any],
        arithmetic: Arithmetic | None = None,
    ) -> tuple[Any, ...]:
        """The values of f as it is written: of an increment three of them."""
        noise = {each.name: value for each, value in zip(self.noises, w, strict=True)}
        values = dict(parameters) | self._named(x, u) | noise
        return _values(self.for_f, trees_of(self.f), values, arithmetic or ARRAYS)

    def moved(
        self,
        x: Sequence[Any],
        u: Sequence[Any],
        w: Sequence[Any],
        parameters: Mapping[str, Any],
        arithmetic: Arithmetic | None = None,
        *,
        passed: Callable[[tuple[Any, ...]], object] | None = None,
    ) -> tuple[Any, ...]:
        """The state one sample later, without the additive noise.

        ``passed`` is called with every state at which f is evaluated on the way.
        """
        own = arithmetic or ARRAYS

        def stated(at: tuple[Any, ...]) -> tuple[Any, ...]:
            if passed is not None:
                passed(at)
            return self.stated(at, u, w, parameters, own)

        state = tuple(x)
        if self.period is None:
            return self._applied(state, stated(state), 1.0, own)
        step = _value(self.period, parameters, own) / float(self.substeps)
        for _ in range(self.substeps):
            rates = stated(state)
            if self.integrator == "rk4":
                rates = self._averaged(state, rates, stated, step, own)
            state = self._applied(state, rates, step, own)
        return state

    def _averaged(
        self,
        x: tuple[Any, ...],
        first: tuple[Any, ...],
        stated: Callable[[tuple[Any, ...]], tuple[Any, ...]],
        step: Any,
        own: Arithmetic,
    ) -> tuple[Any, ...]:
        """(k1 + 2 k2 + 2 k3 + k4) / 6 of Runge and Kutta."""
        second = stated(self._applied(x, first, step * 0.5, own))
        third = stated(self._applied(x, second, step * 0.5, own))
        fourth = stated(self._applied(x, third, step, own))
        slopes = zip(first, second, third, fourth, strict=True)
        return tuple((a + 2.0 * b + 2.0 * c + d) / 6.0 for a, b, c, d in slopes)

    def _applied(
        self, x: Sequence[Any], values: tuple[Any, ...], step: Any, own: Arithmetic
    ) -> tuple[Any, ...]:
        """The state that values of f lead to; ``step``: how long, where time is continuous."""
        result: list[Any] = []
        left = iter(values)
        for each in self.f:
            if isinstance(each, Increment):
                start = tuple(x[each.at : each.at + 4])
                rate = [next(left) for _ in each.by]
                vector = [part * step for part in rate] if self.continuous else rate
                result += turned(start, vector, own)
            elif self.continuous:
                result.append(x[len(result)] + step * next(left))
            else:
                result.append(next(left))
        for at in self.attitudes:
            result[at : at + 4] = normalised(result[at : at + 4], own)
        return tuple(result)

    def _named(self, x: Sequence[Any], u: Sequence[Any]) -> dict[str, Any]:
        return dict(zip(self.states, x, strict=True)) | dict(zip(self.inputs, u, strict=True))


def trees_of(f: Iterable[Motion]) -> tuple[Expression, ...]:
    """The trees in f."""
    return tuple(
        tree for each in f for tree in (each.by if isinstance(each, Increment) else (each,))
    )


def needed(let: Sequence[Definition], roots: Iterable[Expression]) -> tuple[Definition, ...]:
    """The definitions that some trees need, in order."""
    wanted = frozenset[str]().union(*map(names, roots))
    kept: list[Definition] = []
    for name, tree in reversed(let):
        if name in wanted:
            wanted |= names(tree)
            kept.append((name, tree))
    return tuple(reversed(kept))


def turned(q: Sequence[Any], by: Sequence[Any], own: Arithmetic) -> tuple[Any, ...]:
    """Q * exp(by): a quaternion turned by a rotation vector in body axes."""
    square = by[0] * by[0] + by[1] * by[1] + by[2] * by[2]
    near = own["<"](square, SMALL)
    angle = own["sqrt"](own["if"](near, 1.0, square))
    sine = own["if"](
        near,
        0.5 - square / 48.0 + square * square / 3840.0,
        own["sin"](angle * 0.5) / angle,
    )
    cosine = own["if"](near, 1.0 - square / 8.0 + square * square / 384.0, own["cos"](angle * 0.5))
    w, x, y, z = q
    a, b, c = (part * sine for part in by)
    return (
        w * cosine - x * a - y * b - z * c,
        x * cosine + w * a + y * c - z * b,
        y * cosine + w * b + z * a - x * c,
        z * cosine + w * c + x * b - y * a,
    )


def normalised(q: Sequence[Any], own: Arithmetic) -> tuple[Any, ...]:
    """Four numbers as a unit quaternion whose first one is not negative."""
    length = own["sqrt"](q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    scale = own["if"](own["<"](q[0], 0.0), -length, length)
    return tuple(part / scale for part in q)


def _values(
    let: tuple[Definition, ...],
    trees: tuple[Expression, ...],
    values: dict[str, Any],
    own: Arithmetic,
) -> tuple[Any, ...]:
    with np.errstate(all="ignore"):
        for name, tree in let:
            values[name] = _value(tree, values, own)
        return tuple(_value(tree, values, own) for tree in trees)


def _value(tree: Expression, values: Mapping[str, Any], own: Arithmetic) -> Any:
    match tree:
        case Number(value):
            return value
        case Name(identifier):
            return values[identifier]
        case Computed():
            return tree.value(values)
        case Operation("interp", (argument,), table):
            return own["interp"](table, _value(argument, values, own))
        case Operation(operator, arguments):
            return own[operator](*(_value(each, values, own) for each in arguments))


def _looked_up(table: Any, at: Any) -> Any:
    """The value of a table, for arrays."""
    place = np.asarray(at, float)
    x, y = np.array(table.x), np.array(table.y)
    i = np.clip(np.searchsorted(x, place, "right") - 1, 0, len(x) - 2)
    columns = np.zeros((len(table.pieces), 3))
    for row, piece in zip(columns, table.pieces, strict=True):
        row[: len(piece)] = piece
    t = place - x[i]
    inside = y[i] + t * (columns[i, 0] + t * (columns[i, 1] + t * columns[i, 2]))
    held = np.where(place < x[0], y[0], np.where(place >= x[-1], y[-1], inside))
    return _plain(np.where(np.isnan(place), np.nan, held))


def _plain(found: Any) -> Any:
    """An array, or the number that it is."""
    return found[()]


#: For floats and arrays.
ARRAYS: Arithmetic = {
    "+": np.add,
    "-": np.subtract,
    "*": np.multiply,
    "/": np.true_divide,
    "**": np.float_power,
    "neg": np.negative,
    "<": lambda a, b: np.less(a, b) * 1.0,
    "<=": lambda a, b: np.less_equal(a, b) * 1.0,
    ">": lambda a, b: np.greater(a, b) * 1.0,
    ">=": lambda a, b: np.greater_equal(a, b) * 1.0,
    "==": lambda a, b: np.equal(a, b) * 1.0,
    "!=": lambda a, b: np.not_equal(a, b) * 1.0,
    "if": lambda condition, a, b: _plain(np.where(condition, a, b)),
    "interp": _looked_up,
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan2": np.arctan2,
    "min": np.minimum,
    "max": np.maximum,
    **{
        name: getattr(np, name)
        for name in ("exp", "log", "sqrt", "sin", "cos", "tan", "sinh", "cosh", "tanh")
    },
    **{name: getattr(np, name) for name in ("abs", "sign", "hypot")},
}


class Absent(Matrix):
    """What a plant with equations has in place of a matrix: using it is an error."""

    __slots__ = ()
    apart = True

    def __init__(self) -> None:
        """Hold nothing."""

    @property
    def rows(self) -> Any:
        """Refuse."""
        raise SpecError(
            "model.f",
            given="equations where a matrix is needed",
            expected="a linear model: matrices A and C in place of f and h",
        )

    def __eq__(self, other: object) -> bool:
        """Equal to every other absence."""
        return isinstance(other, Absent)

    def __hash__(self) -> int:
        """One for all."""
        return hash(Absent)

    def __reduce__(self) -> tuple[Any, ...]:
        """Be one in another process too."""
        return Absent, ()

    def __repr__(self) -> str:
        """Show what it is."""
        return "Absent()"


ABSENT = Absent()
#: The fields of a plant with equations that hold nothing.
ABSENCE: dict[str, Any] = dict.fromkeys(("A", "B", "C", "D", "c", "d"), ABSENT)
