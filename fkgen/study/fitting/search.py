"""The maximum of a likelihood: SciPy's trust-region search, derivatives by differences in lanes.

A point, its neighbours for gradient and Hessian are one batch of records. A search begins at the
defaults and at the best of points drawn around them; where a record is long, the first searches
take its beginning, and the best of what they find goes on over all of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fkgen.study.fitting.domain import LARGEST, Axis
from fkgen.study.fitting.likelihood import Likelihood

Array = NDArray[np.float64]

STEP = 1e-3  # of a difference, before anything is known
SHARE = 0.003  # of a standard error: steps of differences afterwards
WIDEST = 0.003  # step where nothing is known of a parameter
DRAWN, STARTS = 48, 2  # points around the defaults, and how many of them are begun at
SHORT = 5000  # samples of the first searches
#: Gain in the log-likelihood, by one more Newton step, that ends a search, the last one, and that
#: a maximum may have
NEAR, CLOSE, GOOD = 1e-8, 1e-12, 1e-6
FLAT = 1e-6  # eigenvalue of the scaled information that counts as none
COARSE = 3e3  # times the rounding of a value is the square of the share that it asks for
DOUBT = 10.0  # times the rounding of a value is that of a second difference, at most
ROUNDS = 100
_SPANS = (0.5, 9.2, 4.0)  # around the defaults, with none, one or two bounds
_INWARDS = (1.0, 3.0, 6.0, 12.0, 24.0, 48.0)  # coordinates from a bound at which it has to be lower
_LOST, _LOWER = 1e-6, 1e-3
_SLOPE = 1e-3  # along what is flat: less than that is none


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """The log-likelihood at a point, and its derivatives by the coordinates of free axes."""

    z: Array  # (f,)
    value: float
    gradient: Array  # (f,)
    information: Array  # (f, f): minus the second derivatives
    steps: Array  # (f,): of the differences
    noise: float  # of the value, by rounding

    @property
    def finite(self) -> bool:
        """Whether the filter takes the point and its neighbours."""
        return bool(np.isfinite(self.value))

    @property
    def flatness(self) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Eigenvalues of the information scaled to unit diagonal, directions, which are flat."""
        size, blind = self._size
        scaled = self.information / size[:, None] / size
        scaled[blind] = scaled[:, blind] = 0.0
        values, directions = np.linalg.eigh(scaled)
        level = max(FLAT, DOUBT * min(self.noise / SHARE**2, 1.0 / COARSE))
        return values, directions / size[:, None], np.abs(values) < level

    @property
    def _size(self) -> tuple[Array, NDArray[np.bool_]]:
        """Square roots of the diagonal, and where there is none."""
        diagonal = np.diag(self.information)
        blind = np.abs(diagonal) < np.maximum(FLAT, DOUBT * self.noise / self.steps**2)
        return np.where(blind, 1.0, np.sqrt(np.abs(diagonal))), blind

    @property
    def steady(self) -> Array:
        """The information, which keeps a search where it is along what is flat and has no slope."""
        _, directions, flat = self.flatness
        still = flat & (np.abs(directions.T @ self.gradient) < _SLOPE)
        ways = (directions * self._size[0][:, None] ** 2)[:, still]
        return np.asarray(self.information + ways @ ways.T)

    @property
    def settled(self) -> bool:
        """Whether it is a maximum, to a small part of standard errors."""
        return self.gains_less(GOOD)

    def gains_less(self, gain: float) -> bool:
        """Whether another Newton step gains less, as far as rounding lets it be seen."""
        if not self.finite:
            return False
        values, directions, flat = self.flatness
        slopes = directions.T @ self.gradient
        gains = 0.5 * slopes[~flat] ** 2 / values[~flat]
        return bool(
            (values > -1e-3).all()
            and gains.sum() < max(gain, 10.0 * self.noise)
            and (np.abs(slopes[flat]) < _SLOPE).all()
        )

    def fitting_steps(self, noise: float = 0.0) -> Array:
        """Steps that are a share of standard errors: of a larger one where rounding is coarse."""
        share = max(SHARE, math.sqrt(COARSE * noise))
        known = np.maximum(np.diag(self.information), (share / max(WIDEST, share)) ** 2)
        widest = max(WIDEST, share) * np.maximum(1.0, np.abs(self.z))
        return np.asarray(np.minimum(share / np.sqrt(known), widest))


@dataclass(frozen=True, eq=False)
class Surface:
    """A log-likelihood over the coordinates of some axes, others being held.

    Attributes
    ----------
    axes : tuple of Axis
        All k of them.
    held : mapping of int to float
        Values of those that are not free, by number.
    tick : callable
        Called once per batch.
    """

    likelihood: Likelihood
    axes: tuple[Axis, ...]
    held: Mapping[int, float] = field(default_factory=dict)
    tick: Callable[[], object] = lambda: None

    @property
    def free(self) -> list[int]:
        """The axes that are not held, by number."""
        return [j for j in range(len(self.axes)) if j not in self.held]

    def theta(self, z: Array) -> Array:
        """(V, k) parameters of (V, f) coordinates."""
        found = np.empty((len(z), len(self.axes)))
        for j, value in self.held.items():
            found[:, j] = value
        for at, j in enumerate(self.free):
            found[:, j] = self.axes[j].value(z[:, at])
        return found

    def values(self, z: Array) -> Array:
        """(V,) log-likelihoods; -inf where the filter refuses a sample."""
        theta = self.theta(z)
        found = np.full(len(z), -np.inf)
        there = (np.abs(theta) < LARGEST).all(axis=1)
        if there.any():
            found[there] = self.likelihood(theta[there])
        return np.where(np.isfinite(found), found, -np.inf)

    def neighbours(self, z: Array, steps: Array) -> tuple[Array, list[tuple[int, int]]]:
        """The point, +-e_i, +-(e_i + e_j) with the pairs i < j."""
        f = len(z)
        pairs = [(i, j) for i in range(f) for j in range(i)]
        unit = np.eye(f) * steps
        ways = [*unit, *(unit[i] + unit[j] for i, j in pairs)]
        return z + np.array([np.zeros(f), *(s * way for way in ways for s in (1.0, -1.0))]), pairs

    def noise(self, z: Array, steps: Array) -> float:
        """How far rounding moves values: what a cubic leaves of values close to each other."""
        at = np.linspace(-1.0, 1.0, 9)
        near = self.values(z + 0.05 * at[:, None] * steps)
        bound = np.finfo(float).eps * abs(float(near[0]))
        if not np.isfinite(near).all():
            return bound
        rest = near - near[4]
        rest -= np.polyval(np.polyfit(at, rest, 3), at)
        return max(bound, 3.0 * float(np.sqrt(np.mean(rest**2))))

    def point(self, z: Array, steps: Array, noise: float = 0.0) -> Point:
        """The value and derivatives, by central differences."""
        f = len(z)
        around, pairs = self.neighbours(z, steps)
        found = self.values(around)
        self.tick()
        middle = float(found[0])
        if not np.isfinite(found).all():
            return Point(z, -np.inf, np.zeros(f), np.eye(f), steps, noise)
        plus, minus = found[1::2], found[2::2]
        bend = plus + minus - 2.0 * middle
        information = np.diag(-bend[:f] / steps**2)
        for at, (i, j) in enumerate(pairs, f):
            mixed = -(bend[at] - bend[i] - bend[j]) / (2.0 * steps[i] * steps[j])
            information[i, j] = information[j, i] = mixed
        return Point(z, middle, (plus - minus)[:f] / (2.0 * steps), information, steps, noise)

    def scores(self, point: Point) -> Array:
        """(N, f): derivatives of the terms of the samples at a point, by central differences."""
        f = len(point.z)
        around, _ = self.neighbours(point.z, point.steps)
        terms = self.likelihood.samples(self.theta(around[1 : 2 * f + 1]))
        return np.asarray((terms[::2] - terms[1::2]).T / (2.0 * point.steps))

    def climb(self, z: Array) -> Point:
        """The maximum that a trust-region search finds from z, with steps that fit it."""
        first = np.full(len(z), STEP)
        point = self.climb_by(z, first, self.noise(z, first), NEAR)
        if not point.finite:
            return point
        noise = self.noise(point.z, point.fitting_steps())
        return self.climb_by(point.z, point.fitting_steps(noise), noise)

    def climb_by(self, z: Array, steps: Array, noise: float, gain: float = CLOSE) -> Point:
        """The same with these steps, where values are as coarse, until no more is gained."""
        from scipy.optimize import minimize  # noqa: PLC0415 - slow to import

        known = dict[bytes, Point]()

        def at(z: Array) -> Point:
            key = z.tobytes()
            if key not in known:
                known[key] = self.point(np.array(z), steps, noise)
            return known[key]

        def stop(intermediate_result: Any) -> None:
            if at(intermediate_result.x).gains_less(gain):
                raise StopIteration

        first = at(np.asarray(z, float))
        if not len(z) or not first.finite or first.gains_less(gain):
            return first
        found = minimize(
            lambda z: -at(z).value,
            first.z,
            jac=lambda z: -at(z).gradient,
            hess=lambda z: at(z).steady,
            method="trust-exact",
            callback=stop,
            options={"maxiter": ROUNDS, "gtol": noise / steps.min(), "max_trust_radius": 64.0},
        )
        return at(found.x)


@dataclass(frozen=True, slots=True, eq=False)
class Maximum:
    """Where a likelihood is largest.

    Attributes
    ----------
    surface : Surface
        With the parameters at a bound held there.
    point : Point
        Of the free ones.
    others : tuple of (k + 1,) ndarray
        Further maxima that searches ended at: log-likelihood and parameters.
    """

    surface: Surface
    point: Point
    others: tuple[Array, ...] = ()

    @property
    def theta(self) -> Array:
        """(k,) parameters."""
        return np.asarray(self.surface.theta(self.point.z[np.newaxis])[0])


def drawn(axes: Sequence[Axis], count: int) -> Array:
    """(V, k) coordinates around the defaults; the first are those of the defaults."""
    middle = np.array([axis.coordinate(axis.begin) for axis in axes])
    spans = np.array([_SPANS[len(axis.bounds)] for axis in axes])
    unit = np.random.default_rng(1).uniform(-1.0, 1.0, (count, len(axes)))
    return np.concatenate([middle[np.newaxis], middle + spans * unit])


def maximise(
    likelihood: Likelihood,
    axes: tuple[Axis, ...],
    allowed: Callable[[Array], bool],
    tick: Callable[[], object] = lambda: None,
) -> Maximum:
    """Search from several points, then sit on the bounds at which nothing is lost.

    Parameters
    ----------
    likelihood : Likelihood
    axes : tuple of Axis
    allowed : callable
        Whether a spec may have these parameters as defaults.
    tick : callable
        Called once per batch.
    """
    whole = Surface(likelihood, axes, tick=tick)
    short = replace(whole, likelihood=likelihood.first(SHORT))
    long = likelihood.length > 2 * short.likelihood.length
    begins = drawn(axes, DRAWN)
    found = short.values(begins)
    best = [int(i) for i in np.argsort(-found) if i and np.isfinite(found[i])][:STARTS]
    surface = short if long else whole
    climbed = [surface.climb(begins[i]) for i in (0, *best)]
    ends = [each for each in climbed if each.finite]
    starts = np.array([begins[0], *(each.z for each in ends)])
    if long:
        ends = [whole.climb(starts[int(np.argmax(whole.values(starts)))])]
    if not ends:
        return Maximum(whole, climbed[0])
    top = max(each.value for each in ends)  # the first is as good where nothing tells
    ends.sort(key=lambda each: max(top - each.value - _LOST, 0.0))
    others = tuple(_others(whole, ends)) if not long else ()
    return replace(_seated(whole, ends[0], allowed), others=others)


def _others(surface: Surface, ends: Sequence[Point]) -> list[Array]:
    """Maxima that are lower than the first of them, and elsewhere."""
    found = list[Array]()
    values = [ends[0].value]
    for each in ends[1:]:
        apart = all(abs(each.value - value) > _LOWER for value in values)
        if each.settled and not each.flatness[2].any() and apart:
            found.append(np.array([each.value, *surface.theta(each.z[np.newaxis])[0]]))
            values.append(each.value)
    return found


def _seated(surface: Surface, point: Point, allowed: Callable[[Array], bool]) -> Maximum:
    """Hold parameters at bounds at which the likelihood is as large, and go on with the rest."""
    while True:
        seats = dict[int, float]()
        for at, j in enumerate(surface.free):
            for bound in surface.axes[j].bounds:
                if _sits(surface, point, at, bound, allowed):
                    seats[j] = bound
        if not seats:
            return Maximum(surface, point)
        keep = [at for at, j in enumerate(surface.free) if j not in seats]
        surface = replace(surface, held={**surface.held, **seats})
        point = surface.climb_by(point.z[keep], point.steps[keep], point.noise)


def _sits(
    surface: Surface, point: Point, at: int, bound: float, allowed: Callable[[Array], bool]
) -> bool:
    """Whether the maximum is at a bound: nothing is lost there, and something farther inside."""
    theta = surface.theta(point.z[np.newaxis])[0]
    j = surface.free[at]
    theta[j] = bound
    lost = point.value - float(surface.likelihood(theta[np.newaxis])[0])
    if not lost < _LOST + 10.0 * point.noise or not allowed(theta):
        return False
    axis = surface.axes[j]
    sign = -1.0 if len(axis.bounds) == 2 and bound == axis.high else 1.0
    inwards = np.repeat(point.z[np.newaxis], len(_INWARDS), axis=0)
    inwards[:, at] += sign * np.array(_INWARDS)
    return bool((surface.values(inwards) < point.value - _LOWER).any())
