"""Where parameters may be, and coordinates in which every number is inside.

Bounds are those of the spec's ranges; where there is none, those of variances and probabilities
that depend on this parameter alone. A search goes over coordinates without bounds: the logarithm of
the distance from a bound, the log-odds between two.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError, names_of
from fkgen.problem import Matrix, Parameter, Spec
from fkgen.problem.covariance import negative_direction
from fkgen.problem.text.expression import evaluate, names
from fkgen.runtime.record import choice

Array = NDArray[np.float64]
Inside = Callable[[Mapping[str, float]], bool]

#: Steps from the default, over its size, at which the edge of a domain is looked for.
_STEPS = tuple(4.0**i for i in range(-5, 16))
_DIGITS = 10  # to which an edge is a round number, as variances and probabilities have
_NEAR = 0.01  # of a default at a bound, the distance at which a search begins
#: Largest magnitude of what is tried, and farthest coordinate beside bounds.
LARGEST, FARTHEST = 1e90, 200.0


@dataclass(frozen=True, slots=True)
class Axis:
    """A parameter and its coordinate z."""

    name: str
    default: float
    low: float
    high: float

    @property
    def scale(self) -> float:
        """A unit for it: the size of its default, or its range."""
        if self.default:
            return abs(self.default)
        return 1.0 if math.isinf(self.high - self.low) else self.high - self.low

    @property
    def begin(self) -> float:
        """The default, moved inside where it is at a bound."""
        step = _NEAR * (self.scale if math.isinf(self.high - self.low) else self.high - self.low)
        return max(min(self.default, self.high - step), self.low + step)

    @property
    def bounds(self) -> list[float]:
        """The bounds that there are."""
        return [each for each in (self.low, self.high) if math.isfinite(each)]

    def value(self, z: Array) -> Array:
        """The parameter at coordinates."""
        z = np.asarray(z, float)
        if not self.bounds:
            return z * self.scale
        z = np.clip(z, -FARTHEST, FARTHEST)
        if len(self.bounds) == 2:
            odds = np.exp(-np.abs(z))
            away = (self.high - self.low) * odds / (1.0 + odds)
            return np.where(z < 0.0, self.low + away, self.high - away)
        return self.low + np.exp(z) if math.isfinite(self.low) else self.high - np.exp(z)

    def slope(self, z: float) -> float:
        """Derivative of the value by z."""
        if not self.bounds:
            return self.scale
        if len(self.bounds) == 2:
            odds = math.exp(-abs(z))
            return (self.high - self.low) * odds / (1.0 + odds) ** 2
        return math.exp(z) if math.isfinite(self.low) else -math.exp(z)

    def coordinate(self, value: float) -> float:
        """The coordinate of a number inside the bounds."""
        if not self.bounds:
            return value / self.scale
        if len(self.bounds) == 2:
            return math.log(value - self.low) - math.log(self.high - value)
        return math.log(value - self.low if math.isfinite(self.low) else self.high - value)


def estimated(spec: Spec, estimate: str | Sequence[str]) -> tuple[Parameter, ...]:
    """The parameters to estimate; a vector stands for its entries.

    Raises
    ------
    DataError
        If a name is none of a parameter, or of one that occurs nowhere.
    """
    found = list[Parameter]()
    stated = spec.stated_parameters
    known = dict.fromkeys([*(each.of or each.name for each in stated), *(e.name for e in stated)])
    given = names_of("estimate", estimate, "names of parameters, such as ('q', 'r')")
    if not given:
        raise DataError("estimate", given="no names", expected="names of parameters")
    for name in given:
        entries = [each for each in stated if name in (each.name, each.of)]
        if not entries:
            there = "a name in [parameters], where there is none"
            expected = choice(name, list(known)) if known else there
            raise DataError("estimate", given=repr(name), expected=expected)
        found += entries
    for each in found:
        if found.count(each) > 1:
            raise DataError("estimate", given=f"{each.name!r} twice", expected="every name once")
        _demand_use(spec, each)
    return tuple(found)


def axes_of(spec: Spec, parameters: Sequence[Parameter], inside: Inside) -> tuple[Axis, ...]:
    """Parameters with their bounds."""
    return tuple(_axis(each, parameters, spec.defaults, inside) for each in parameters)


def _demand_use(spec: Spec, parameter: Parameter) -> None:
    """Refuse a parameter of which no likelihood can depend."""
    used = frozenset().union(*map(names, (*spec.expressions, *spec.start_expressions)))
    used |= frozenset().union(*map(names, spec.trees)) | {str(spec.model.sample_time)}
    if parameter.name not in used:
        given = f"{parameter.name!r}, which occurs nowhere in the model or its faults"
        raise DataError("estimate", given=given, expected="parameters that the model depends on")
    if parameter.low == parameter.high:
        given = f"{parameter.name!r}, whose range is one number, {parameter.low:g}"
        raise DataError("estimate", given=given, expected="a range from min to a larger max")


def _axis(
    own: Parameter, estimated: Sequence[Parameter], defaults: Mapping[str, float], inside: Inside
) -> Axis:
    """A parameter with its bounds; an edge that moves with other parameters is none."""
    moved = dict(defaults)
    for each in estimated:
        if each.name != own.name:
            near = Axis(each.name, each.default, each.low, each.high)
            step = 0.03 * near.scale
            moved[each.name] = min(max(each.default + step, each.low), each.high)
            if not inside({**defaults, each.name: moved[each.name]}):
                moved[each.name] = each.default - step
    axis = Axis(own.name, own.default, own.low, own.high)
    edges = []
    for sign, stated in ((-1.0, own.low), (1.0, own.high)):
        found = stated
        if math.isinf(stated):
            found = _edge(axis, sign, defaults, inside)
            apart = math.isfinite(found) and _edge(axis, sign, moved, inside) != found
            found = stated if apart else found
        edges.append(found)
    return replace(axis, low=edges[0], high=edges[1])


def _edge(axis: Axis, sign: float, values: Mapping[str, float], inside: Inside) -> float:
    """Where the domain ends in a direction; infinite where it does not."""
    near, found = axis.default, None
    for step in _STEPS:
        far = axis.default + sign * step * axis.scale
        if not inside({**values, axis.name: far}):
            found = far
            break
        near = far
    if found is None:
        return sign * math.inf
    for exact in (0.0, 1.0):  # where variances and probabilities end
        between = min(near, found) <= exact <= max(near, found)
        at, beyond = ({**values, axis.name: exact + sign * e * axis.scale} for e in (0.0, 1e-9))
        if between and inside(at) and not inside(beyond):
            return exact
    while abs(found - near) > 1e-14 * max(abs(found), abs(near)):
        middle = 0.5 * (near + found)
        if middle in (near, found):
            break
        near, found = (middle, found) if inside({**values, axis.name: middle}) else (near, middle)
    rounded = float(f"{near:.{_DIGITS}g}")
    return rounded if inside({**values, axis.name: rounded}) else near


def covariances_hold(spec: Spec) -> Inside:
    """Whether the covariances that depend on parameters have no negative direction."""
    told = list(_covariances(spec))
    noises = [each.variance for some in spec.equations for each in some.noises]
    variances = [each for each in noises if names(each)]

    def holds(values: Mapping[str, float]) -> bool:
        try:
            found = [_whole(parts, values) for parts in told]
            found += [np.array([[evaluate(each, values)]]) for each in variances]
        except ArithmeticError:
            return False
        finite = all(np.isfinite(each).all() for each in found)
        return finite and not any(map(negative_direction, found))

    return holds


def _covariances(spec: Spec) -> Iterator[tuple[Matrix, ...]]:
    """Q, R and P0 of plants; Q, S and R together where noises are correlated."""
    model = spec.model
    for plant in spec.plants:
        parts: list[tuple[Matrix, ...]] = [(plant.Q,), (plant.R,)]
        if plant is model and not model.S.is_zero:
            parts = [(model.Q, model.S, model.R)]
        yield from (each for each in parts if any(m.names for m in each))
    if model.P0.names:
        yield (model.P0,)


def _whole(parts: tuple[Matrix, ...], values: Mapping[str, float]) -> Array:
    found = [each.values(values) for each in parts]
    if len(found) == 1:
        return found[0]
    Q, S, R = found
    return np.block([[Q, S], [S.T, R]])
