"""Several Gaussians as one of the same mean and covariance, and their common innovation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca

from fkgen.estimators.gaussian.decorrelation import are_many, whiten
from fkgen.estimators.gaussian.estimate import off_by
from fkgen.estimators.gaussian.sequential import Conditioned
from fkgen.estimators.gaussian.ud import DUST
from fkgen.estimators.models.weights import TINY
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.index import At, packed
from fkgen.symbolic.lifting.equations import Lifted, box_minus, turned_by
from fkgen.symbolic.linalg import (
    column,
    congruence,
    diagonal,
    is_zero,
    order,
    outer_lower,
    reduced,
    spread,
    total,
    unpack,
    weighted_sum,
)
from fkgen.symbolic.plant import DENSE_STATES, Plant

#: Shares of a column that agree to so many decimals are the same.
DIGITS = 13

#: How many times as large as the variances that it is added to the spread of means may be. A
#: product of one vector with itself is rounded in every direction, and what is left of that is to
#: be small beside those variances.
WIDEST = {"double": 1e9, "float": 1e3}

#: Mean and packed covariance.
Gaussian = tuple[ca.SX, ca.SX]


@dataclass(frozen=True, slots=True)
class Chart:
    """Coordinates in which estimates are merged: errors about one of them.

    They are the states themselves where no state is an angle or an attitude.
    """

    builder: PhaseBuilder
    plant: Plant
    name: str
    origin: ca.SX

    @property
    def _lifted(self) -> Lifted | None:
        """The plant by functions, if something of its state turns."""
        found = self.plant.lifted
        return found if found is not None and (found.attitudes or found.angles) else None

    def inward(self, parts: Sequence[Gaussian]) -> list[Gaussian]:
        """Estimates in these coordinates."""
        lifted = self._lifted
        return (
            list(parts)
            if lifted is None
            else [self._errors(lifted, i, part) for i, part in enumerate(parts)]
        )

    def _errors(self, lifted: Lifted, i: int, part: Gaussian) -> Gaussian:
        state, packed = part
        if state is self.origin:
            return ca.SX.zeros(self.plant.ne), packed
        apart = box_minus(state, self.origin, lifted)
        errors = self.builder.define(f"{self.name}_errors_{i}", apart)
        if lifted.attitudes:
            turn = turned_by(lifted.attitudes, errors, back=True)
            (turn,) = self.builder.name_all(f"{self.name}_turn_{i}", (turn,))
            carried = congruence(turn, unpack(packed, self.plant.ne))
            packed = self.builder.define(f"{self.name}_carried_{i}", carried)
        return errors, packed

    def outward(self, merged: Gaussian, tag: str = "") -> Gaussian:
        """An estimate in these coordinates as one of the state."""
        if self._lifted is None:
            return merged
        errors = self.builder.define(f"{self.name}_mean{tag}", merged[0])
        of = f"_{self.name}{tag}"
        state, turn = off_by(self.builder, self.plant, self.origin, errors, of)
        if not self.plant.attitudes:
            return state, merged[1]
        packed = congruence(turn, unpack(merged[1], self.plant.ne))
        return state, self.builder.define(f"turned{of}", packed)


@dataclass(frozen=True, slots=True)
class Limits:
    """What spreads of means are measured by: reciprocals of `WIDEST` times variances, (n,).

    Means that are further apart are those of a sample that no mode expects. What is left of their
    spread is still more than any other.
    """

    reciprocals: ca.SX
    scalar: str

    @classmethod
    def of(cls, builder: PhaseBuilder, name: str, parts: Sequence[Gaussian], scalar: str) -> Limits:
        """Those of the variances of all parts together; none where nothing varies."""
        variances = [ca.vertcat(*diagonal(packed)) for _, packed in parts]
        whole = WIDEST[scalar] * total(variances)
        nothing = whole <= 0
        return cls(builder.define(f"{name}_limits", (1 - nothing) / (whole + nothing)), scalar)

    def largest(self, apart: ca.SX) -> ca.SX:
        """The largest factor of the square of a difference of means."""
        return 1 / (ca.dot(self.reciprocals, apart * apart) + TINY[self.scalar])

    def bounded(self, weights: ca.SX, apart: Sequence[ca.SX]) -> ca.SX:
        """Weights of such squares, or less, (N, 1)."""
        return column([ca.fmin(weights[i], self.largest(each)) for i, each in enumerate(apart)])


def mixture(
    chart: Chart,
    weights: ca.SX,
    parts: Sequence[Gaussian],
    tag: str = "",
    *,
    named: bool = True,
    lasting: bool = False,
) -> Gaussian:
    """Mean and packed covariance of a mixture of Gaussians; the mean is computed once.

    What is ``lasting`` is carried to the next sample.
    """
    own, outer = chart.inward(parts), weights
    mean = weighted_sum(weights, [each for each, _ in own])
    if named:
        mean = chart.builder.define(f"{chart.name}_state{tag}", mean)
    if lasting:
        name = f"{chart.name}{tag}"
        scalar = chart.plant.scalar
        outer = spread_weights(chart.builder, name, weights, own, mean, scalar=scalar)
    if order(own[0][1]) < DENSE_STATES or not named:
        covariance = mixture_covariance(weights, own, mean, outer)
        return chart.outward((mean, covariance), tag)
    within = weights, [each for _, each in own]
    apart = outer, [each - mean for each, _ in own]
    name = f"{chart.name}_covariance{tag}"
    return chart.outward((mean, _merged_in_loops(chart.builder, name, within, apart)), tag)


def spread_weights(
    builder: PhaseBuilder,
    name: str,
    weights: ca.SX,
    parts: Sequence[Gaussian],
    mean: ca.SX,
    *,
    scalar: str,
) -> ca.SX:
    """Weights of the spread of means that is carried on: no more than its variances bear."""
    if len(parts) < 2 or order(parts[0][1]) < 2:  # one variance is rounded in one direction
        return weights
    limits = Limits.of(builder, name, parts, scalar)
    bounded = limits.bounded(weights, [each - mean for each, _ in parts])
    return builder.define(f"{name}_outer", bounded)


def mixture_covariance(
    weights: ca.SX, parts: Sequence[Gaussian], mean: ca.SX, outer: ca.SX | None = None
) -> ca.SX:
    """Packed covariance of a mixture of Gaussians with this ``mean``.

    ``outer`` are weights of the spread of means that differ from those of the covariances.
    """
    means, covariances = zip(*parts, strict=True)
    outer = weights if outer is None else outer
    return weighted_sum(weights, covariances) + spread(outer, means, mean)


def combined_innovation(
    builder: PhaseBuilder,
    held: ca.SX,
    predicted: list[ca.SX],
    found: Sequence[Conditioned],
    angles: tuple[tuple[int, ...], ca.SX],
    *,
    scalar: str,
) -> dict[str, ca.SX]:
    """Innovation of a mixture of predictions of y, its covariance, its NIS over the rows present.

    ``held`` are the probabilities before y[k], ``found`` is what each mode made of y[k]. Of rows
    that are ``angles``, beside y, predictions count as near the first one as they come.
    """
    wraps, y = angles
    predicted = [ca.SX(each) for each in predicted]
    for row in wraps:
        for each in predicted[1:]:
            each[row] = predicted[0][row] + reduced(each[row] - predicted[0][row])
    S = _combined_variance(builder, held, [each.innovation_covariance for each in found], predicted)
    nu = ca.SX(weighted_sum(held, [f.innovation for f in found]))
    for row in wraps:
        mean = weighted_sum(held, predicted)
        nu[row] = builder.local(f"combined_angle_{row}", 1, initial=0.0)
        with builder.if_present(row):
            builder.assign({f"combined_angle_{row}": reduced(y[row] - mean[row])})
    nu = builder.define("combined_innovation", nu)
    if len(found) == 1:
        return {"innovation": nu, "innovation_covariance": S, "nis": found[0].nis}
    least = 4.0 * nu.numel() * DUST[scalar]  # S is positive definite as every part of it is
    nis = whiten(builder, S, nu, "_combined", least=least).quadratic(ca.SX(1))
    return {"innovation": nu, "innovation_covariance": S, "nis": nis}


def _combined_variance(
    builder: PhaseBuilder, held: ca.SX, covariances: list[ca.SX], predicted: list[ca.SX]
) -> ca.SX:
    """Covariance of a mixture of predictions of y, packed."""
    weights, means = _distinct(held, predicted)
    mean, size = weighted_sum(held, predicted), covariances[0].numel()
    if len(covariances) == 1 or not are_many(size * (2 * len(covariances) + 3 * len(means))):
        S = weighted_sum(held, covariances) + spread(weights, means, mean)
        return builder.define("combined_variance", S)
    apart = [each - mean for each in means] if len(means) > 1 else []
    return _merged_in_loops(builder, "combined_variance", (held, covariances), (weights, apart))


def _merged_in_loops(
    builder: PhaseBuilder,
    name: str,
    within: tuple[ca.SX, Sequence[ca.SX]],
    between: tuple[ca.SX, Sequence[ca.SX]],
) -> ca.SX:
    """The sum of w_m P_m, packed, and of v_m d_m d_m'; ``within`` is (w, P), ``between`` (v, d)."""
    (w, covariances), (v, deviations) = within, between
    found = builder.local(name, covariances[0].numel())
    names = [builder.array(f"{name}_of_{m}", each) for m, each in enumerate(covariances)]
    apart = [builder.array(f"{name}_apart_{m}", each) for m, each in enumerate(deviations)]
    with builder.loop("i", 0, order(covariances[0])) as i:
        factors = [
            builder.define(f"weighted_{each}", v[m] * builder.at(each, i))
            for m, each in enumerate(apart)
        ]
        with builder.loop("k", 0, i + 1) as k:
            at = packed(i, k)
            entry = weighted_sum(w, [builder.at(each, at) for each in names])
            for factor, each in zip(factors, apart, strict=True):
                entry += factor * builder.at(each, k)
            builder.assign({At(name, at): entry})
    return found


def _distinct(weights: ca.SX, values: list[ca.SX]) -> tuple[ca.SX, list[ca.SX]]:
    """Weights of values that are constants, such as predictions without a signal, put together."""
    constant = [i for i, value in enumerate(values) if value.is_constant()]
    if len({str(values[i]) for i in constant}) != 1 or len(constant) == len(values):
        return weights, values
    others = [i for i in range(len(values)) if i not in constant]
    kept = column([*(weights[i] for i in others), total(weights[i] for i in constant)])
    return kept, [*(values[i] for i in others), values[constant[0]]]


class Mixer:
    """The same Gaussians under several weights, each time as one of equal mean and covariance.

    They are merged two by two, P = a P_1 + b P_2 + a b d d' with a + b = 1 and d the difference of
    the means: positive semidefinite term by term, and blind to means of weight zero. Where columns
    of a kernel agree on a pair but for a factor, as those of two independent chains do, the pair is
    merged once for all of them. `TINY` is added to the weight of a pair before dividing by it; it
    is nothing beside a weight that counts. What is ``lasting`` is carried to the next sample.
    """

    def __init__(
        self,
        builder: PhaseBuilder,
        name: str,
        parts: list[Gaussian],
        scalar: str,
        *,
        lasting: bool = True,
    ) -> None:
        self.builder, self.name, self.parts = builder, name, parts
        self.tiny = TINY[scalar]
        lasting = lasting and order(parts[0][1]) > 1  # one variance is rounded in one direction
        self.limits = Limits.of(builder, name, parts, scalar) if lasting else None
        self._products: dict[range, tuple[ca.SX | None, ca.SX]] = {}
        self._known: dict[tuple[object, ...], Gaussian] = {}

    def under(
        self, weights: ca.SX, tag: str = "", column: tuple[float, ...] | None = None
    ) -> Gaussian:
        """The one Gaussian under weights that sum to one.

        ``column`` is what the weights are proportional to besides a common factor of each
        Gaussian; none of it may be zero.
        """
        return self._merge(range(len(self.parts)), weights, tag, column)

    def _merge(
        self, which: range, weights: ca.SX, tag: str, column: tuple[float, ...] | None
    ) -> Gaussian:
        """The Gaussian of the parts in ``which``, by halves."""
        alive = [i for i in which if not is_zero(weights[i])]
        if len(alive) <= 1:
            return self.parts[alive[0] if alive else which[0]]
        key = (which, tag if column is None else _shape(column, which))
        if key in self._known:
            return self._known[key]
        middle = (len(which) + 1) // 2
        halves = which[:middle], which[middle:]
        for half, other in (halves, halves[::-1]):
            if not set(half) & set(alive):
                return self._merge(other, weights, tag, column)
        label = f"{self.name}{tag}_{which[0]}_{which[-1]}"
        share = self._share([total(weights[i] for i in half) for half in halves], label, which)
        (x, P), (z, Q) = (self._merge(half, weights, tag, column) for half in halves)
        mean = self.builder.define(f"{label}_mean", share[0] * x + share[1] * z)
        name, factor = f"{label}_covariance", share[0] * share[1]
        if order(P) >= DENSE_STATES:
            if self.limits is not None:
                bounded = ca.fmin(factor, self.limits.largest(x - z))
                factor = self.builder.define(f"{label}_factor", bounded)
            covariance = _merged_in_loops(self.builder, name, (share, (P, Q)), (factor, [x - z]))
        else:
            largest, product = self._spread(which, x, z, label)
            if largest is not None:
                factor = self.builder.define(f"{label}_factor", ca.fmin(factor, largest))
            outer = product(factor)
            covariance = self.builder.define(name, share[0] * P + share[1] * Q + outer)
        self._known[key] = mean, covariance
        return self._known[key]

    def _share(self, masses: list[ca.SX], label: str, which: range) -> ca.SX:
        """Weights of the two halves within their sum, which is one for the whole."""
        if len(which) < len(self.parts):
            inverse = self.builder.define(
                f"{label}_inverse", 1 / (masses[0] + masses[1] + self.tiny)
            )
            masses = [mass * inverse for mass in masses]
        return self.builder.define(f"{label}_share", column(masses))

    def _spread(
        self, which: range, x: ca.SX, z: ca.SX, label: str
    ) -> tuple[ca.SX | None, Callable[[ca.SX], ca.SX]]:
        """Product of the difference of two means with itself, times a factor; shared for leaves.

        Before it the largest such factor.
        """
        builder, limits, pair = self.builder, self.limits, len(which) == 2
        if which in self._products:
            largest, product = self._products[which]
            return largest, lambda factor: factor * product
        name = f"{self.name}_apart_{which[0]}_{which[-1]}" if pair else f"{label}_apart"
        apart = builder.define(name, x - z)
        largest = None if limits is None else builder.define(f"{name}_most", limits.largest(apart))
        if not pair:
            return largest, lambda factor: outer_lower(factor * apart, apart)
        product = builder.define(f"{name}_squared", outer_lower(apart, apart))
        self._products[which] = largest, product
        return largest, lambda factor: factor * product


def _shape(column: tuple[float, ...], which: range) -> tuple[float, ...]:
    """Entries relative to their sum, rounded so that proportional ones compare equal."""
    whole = sum(column[i] for i in which)
    return tuple(round(column[i] / whole, DIGITS) for i in which)
