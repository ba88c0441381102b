"""Profile likelihood of one parameter: the others are where they make the records most likely."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fkgen.runtime.record import whole
from fkgen.study.fitting.domain import Axis
from fkgen.study.fitting.search import NEAR, Maximum, Point

Array = NDArray[np.float64]

#: Coordinates from the estimate, and times the first step, beyond which an interval has no end.
_FARTHEST, _MANY = 60.0, 1e9
_TOLERANCE = 1e-5  # of the distance of an end from the estimate
_BEYOND = 1.3  # times the interval of 95 % are shown


@dataclass(frozen=True, eq=False)
class Profile:
    """The largest log-likelihood for values of one parameter.

    Attributes
    ----------
    name : str
    values : (N,) ndarray
        Of the parameter, increasing; the estimate is one of them.
    log_likelihood : (N,) ndarray
        Absolute; -inf where the filter refuses a sample.
    """

    name: str
    values: Array
    log_likelihood: Array


@dataclass(frozen=True, eq=False)
class Curve:
    """The profile of axis j around a maximum.

    Attributes
    ----------
    error : float
        Standard error of the parameter; NaN or infinite where it has none.
    inflation : float
        By which the deviance is divided.
    """

    maximum: Maximum
    j: int
    error: float
    inflation: float
    _latest: dict[str, Point] = field(default_factory=dict, repr=False)

    def at(self, value: float) -> float:
        """The largest log-likelihood where the parameter has a value."""
        surface = self.maximum.surface
        seats = {j: bound for j, bound in surface.held.items() if j != self.j}
        found = [self._with({**seats, self.j: value}, "seated")]
        if seats:  # what is at a bound may leave it
            found.append(self._with({self.j: value}, "free"))
        return max(found)

    def _with(self, held: dict[int, float], kind: str) -> float:
        whole_surface = self.maximum.surface
        surface = replace(whole_surface, held=held)
        before = self._latest.get(kind)
        if before is not None and before.finite:
            z, steps = before.z, before.steps
        else:
            theta = self.maximum.theta
            axes = [whole_surface.axes[j] for j in surface.free]
            inside = [
                axis.begin if j in whole_surface.held else theta[j]
                for j, axis in zip(surface.free, axes, strict=True)
            ]
            z = np.array([a.coordinate(v) for a, v in zip(axes, inside, strict=True)])
            steps = self._steps(surface.free)
        point = surface.climb_by(z, steps, self.maximum.point.noise, NEAR)
        self._latest[kind] = point
        return point.value

    def _steps(self, free: list[int]) -> Array:
        """Steps of the maximum, where it has them."""
        known = dict(zip(self.maximum.surface.free, self.maximum.point.steps, strict=True))
        return np.array([known.get(j, 1e-3) for j in free])

    def interval(self, level: float) -> tuple[float, float]:
        """Both ends of the interval of a confidence."""
        from scipy.special import chdtri  # noqa: PLC0415 - scipy.stats would take a second

        allowed = 0.5 * self.inflation * float(chdtri(1, 1.0 - level))
        return self._end(-1.0, allowed), self._end(1.0, allowed)

    def _end(self, sign: float, allowed: float) -> float:
        """Where the profile has fallen by what is allowed, or the bound before that."""
        from scipy.optimize import brentq  # noqa: PLC0415 - slow to import

        surface, estimate = self.maximum.surface, float(self.maximum.theta[self.j])
        axis = surface.axes[self.j]
        bound = axis.low if sign < 0.0 else axis.high
        if estimate == bound:
            return bound
        place, value_of, step = self._scale(sign, allowed)
        self._latest.clear()

        known = {place: -allowed}  # searches from other points may end a little lower

        def over(t: float) -> float:
            if t not in known:
                known[t] = min(self.maximum.point.value - self.at(value_of(t)) - allowed, 1e300)
            return known[t]

        logarithmic = bool(axis.bounds) and self.j not in surface.held
        distance, most = abs(step), _FARTHEST if logarithmic else _MANY * abs(step)
        near, far = place, place + step
        while over(far) < 0.0:
            if value_of(far) == bound or distance >= most:
                return bound
            distance = min(3.0 * distance, most)
            near, far = far, place + math.copysign(distance, step)
        end = brentq(over, near, far, xtol=_TOLERANCE * abs(far - place), rtol=1e-12)
        return float(value_of(end))

    def _scale(self, sign: float, allowed: float) -> tuple[float, Callable[[float], float], float]:
        """Where the estimate is, values of other places, and a first step towards the end."""
        surface, estimate = self.maximum.surface, float(self.maximum.theta[self.j])
        axis = surface.axes[self.j]
        if self.j in surface.held:  # from a bound linearly: its coordinate is infinite
            width = axis.scale if math.isinf(axis.high - axis.low) else axis.high - axis.low
            return estimate, lambda t: min(max(t, axis.low), axis.high), sign * 1e-3 * width
        z = axis.coordinate(estimate)
        error = abs(self.error / axis.slope(z))
        reach = math.sqrt(2.0 * allowed) * (error if math.isfinite(error) else 0.1)
        turn = -1.0 if math.isinf(axis.low) and math.isfinite(axis.high) else 1.0
        return z, partial(_value, axis.value), sign * turn * reach

    def profile(self, points: int, around: tuple[float, float]) -> Profile:
        """Values around an interval, from the estimate outwards."""
        count = whole("points", points, least=3, expected="a whole number of at least 3")
        axis = self.maximum.surface.axes[self.j]
        estimate = float(self.maximum.theta[self.j])
        bounds = (axis.low, axis.high)
        left = (count - 1) * (estimate > axis.low) // (1 + (estimate < axis.high))
        counts = left, count - 1 - left
        below, above = (
            _outwards(axis, estimate, each) for each in zip(bounds, around, counts, strict=True)
        )
        found = {estimate: self.maximum.point.value}
        for side in (below, above):
            self._latest.clear()
            for value in side.tolist():
                found[value] = self.at(value)
        values = np.array(sorted(found))
        return Profile(axis.name, values, np.array([found[value] for value in values.tolist()]))


def _outwards(axis: Axis, estimate: float, side: tuple[float, float, int]) -> Array:
    """So many values from the estimate to an end of its interval and beyond, within the bound.

    They are equally far apart as the search sees them: a logarithm shows how steep it gets near 0.
    """
    bound, end, count = side
    sign = math.copysign(1.0, bound - estimate)
    steps = np.arange(1, count + 1) / max(count, 1)
    known = math.isfinite(end) and end != estimate
    if known and end not in axis.bounds and estimate not in axis.bounds:
        z = axis.coordinate(estimate)
        return axis.value(z + _BEYOND * steps * (axis.coordinate(end) - z))
    distance = abs(end - estimate) if known else max(1.0, abs(estimate))
    far = estimate + sign * _BEYOND * distance
    far = max(far, bound) if sign < 0.0 else min(far, bound)
    return np.asarray(estimate + steps * (far - estimate))


def _value(of: Callable[[Array], Array], z: float) -> float:
    return float(of(np.array(z)))
