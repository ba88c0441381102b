"""Several Gaussians as one of the same mean and covariance, and their common innovation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca

from fkgen.estimators.gaussian.conditioning import Conditioned
from fkgen.estimators.gaussian.elimination import whiten
from fkgen.symbolic.builder import Script
from fkgen.symbolic.linalg import column, is_zero, outer_lower, spread, weighted_sum

#: Shares of a column that agree to so many decimals are the same.
DIGITS = 13


def combined_innovation(
    script: Script, held: ca.SX, predicted: list[ca.SX], found: list[Conditioned]
) -> dict[str, ca.SX]:
    """Innovation of a mixture of predictions of y, its covariance, its NIS over the rows present.

    ``held`` are the probabilities before y[k], ``found`` is what each mode made of y[k].
    """
    mean = weighted_sum(held, predicted)
    S = weighted_sum(held, [each.innovation_covariance for each in found])
    S = script.let("combined_variance", S + spread(*_distinct(held, predicted), mean))
    nu = script.let("combined_innovation", weighted_sum(held, [f.innovation for f in found]))
    results = {"innovation": nu, "innovation_covariance": S}
    if len(found) == 1:
        return {**results, "nis": found[0].nis}
    return {**results, "nis": whiten(script, S, nu, "_combined").quadratic(ca.SX(1))}


def _distinct(weights: ca.SX, values: list[ca.SX]) -> tuple[ca.SX, list[ca.SX]]:
    """Weights of values that are constants, such as predictions without a signal, put together."""
    constant = [i for i, value in enumerate(values) if value.is_constant()]
    if len({str(values[i]) for i in constant}) != 1 or len(constant) == len(values):
        return weights, values
    others = [i for i in range(len(values)) if i not in constant]
    together = sum((weights[i] for i in constant[1:]), start=weights[constant[0]])
    kept = column([*(weights[i] for i in others), together])
    return kept, [*(values[i] for i in others), values[constant[0]]]


@dataclass(frozen=True, slots=True)
class _Merged:
    """One Gaussian for several: its mean and packed covariance."""

    mean: ca.SX
    covariance: ca.SX


class Mixer:
    """The same Gaussians under several weights, each time as one of equal mean and covariance.

    They are merged two by two, P = a P_1 + b P_2 + a b d d' with a + b = 1 and d the difference of
    the means: positive semidefinite term by term, and blind to means of weight zero. Where columns
    of a kernel agree on a pair but for a factor, as those of two independent chains do, the pair is
    merged once for all of them. ``tiny`` is added to the weight of a pair before dividing by it;
    it is nothing beside a weight that counts.
    """

    def __init__(
        self, script: Script, name: str, parts: list[tuple[ca.SX, ca.SX]], tiny: float
    ) -> None:
        self.script, self.name, self.tiny = script, name, tiny
        self.parts = [_Merged(*part) for part in parts]
        self._products: dict[tuple[int, int], ca.SX] = {}
        self._known: dict[tuple[object, ...], _Merged] = {}

    def under(
        self, weights: ca.SX, tag: str = "", column: tuple[float, ...] | None = None
    ) -> tuple[ca.SX, ca.SX]:
        """Mean and packed covariance under weights that sum to one.

        ``column`` is what the weights are proportional to besides a common factor of each
        Gaussian; none of it may be zero.
        """
        whole = self._merge(range(len(self.parts)), weights, tag, column)
        return whole.mean, whole.covariance

    def _merge(
        self, which: range, weights: ca.SX, tag: str, column: tuple[float, ...] | None
    ) -> _Merged:
        """The Gaussian of the parts in ``which``, by halves."""
        alive = [i for i in which if not is_zero(weights[i])]
        if len(alive) <= 1:
            return self.parts[alive[0] if alive else which[0]]
        whole = len(which) == len(self.parts)
        key = (which, tag if column is None else _shape(column, which))
        if key in self._known:
            return self._known[key]
        middle = (len(which) + 1) // 2
        halves = which[:middle], which[middle:]
        for half, other in (halves, halves[::-1]):
            if not set(half) & set(alive):
                return self._merge(other, weights, tag, column)
        label = f"{self.name}{tag}_{which[0]}_{which[-1]}"
        masses = [_mass(weights, half) for half in halves]
        share = self._share(masses, label, whole=whole)
        first, second = (self._merge(half, weights, tag, column) for half in halves)
        spread = self._spread(halves, first, second, label)
        mean = share[0] * first.mean + share[1] * second.mean
        covariance = share[0] * first.covariance + share[1] * second.covariance
        merged = _Merged(
            self.script.let(f"{label}_mean", mean),
            self.script.let(f"{label}_covariance", covariance + spread(share[0] * share[1])),
        )
        self._known[key] = merged
        return merged

    def _share(self, masses: list[ca.SX], label: str, *, whole: bool) -> ca.SX:
        """Weights of the two halves within their sum, which is one for the whole."""
        if not whole:
            inverse = self.script.let(f"{label}_inverse", 1 / (masses[0] + masses[1] + self.tiny))
            masses = [mass * inverse for mass in masses]
        return self.script.let(f"{label}_share", column(masses))

    def _spread(
        self, halves: tuple[range, range], first: _Merged, second: _Merged, label: str
    ) -> Callable[[ca.SX], ca.SX]:
        """Product of the difference of two means with itself, times a factor; shared for leaves."""
        if any(len(half) > 1 for half in halves):
            difference = self.script.let(f"{label}_apart", first.mean - second.mean)
            return lambda factor: outer_lower(factor * difference, difference)
        pair = halves[0][0], halves[1][0]
        if pair not in self._products:
            names = f"{self.name}_apart_{pair[0]}_{pair[1]}"
            difference = self.script.let(names, first.mean - second.mean)
            self._products[pair] = self.script.let(
                f"{names}_squared", outer_lower(difference, difference)
            )
        product = self._products[pair]
        return lambda factor: factor * product


def _mass(weights: ca.SX, which: range) -> ca.SX:
    return sum((weights[i] for i in which[1:]), start=weights[which[0]])


def _shape(column: tuple[float, ...], which: range) -> tuple[float, ...]:
    """Entries relative to their sum, rounded so that proportional ones compare equal."""
    total = sum(column[i] for i in which)
    return tuple(round(column[i] / total, DIGITS) for i in which)
