"""Which filter to take: the cheapest of those that are as good as the best, as far as is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fkgen.study.comparisons.estimates import Estimate, error_of
from fkgen.study.comparisons.footprint import Footprint

Array = NDArray[np.float64]

#: Paired differences within so many standard errors may be chance.
TIE = 2.0
#: They are ties if they cannot be larger than this share of the smaller error; else, not decided.
MARGIN = 0.1
#: A filter whose NEES is farther from 1 is not believed about its own error.
HONEST = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Standing:
    """What counts for the choice."""

    label: str
    footprint: Footprint
    value: float
    influence: Array

    @property
    def price(self) -> tuple[int, int, int]:
        """Operations, then code, then memory."""
        print_ = self.footprint
        return print_.cost, min(print_.flash.values(), default=0), print_.state

    def not_worse_than(self, other: Standing) -> bool:
        """Whether its error is smaller, or a tie, over the same trials."""
        gap, doubt = self.value - other.value, TIE * self.apart(other)
        return gap <= 0.0 or (gap <= doubt and gap + doubt <= MARGIN * other.value)

    def undecided_against(self, other: Standing) -> bool:
        """Whether its larger error may be chance, and may as well be much larger."""
        gap = self.value - other.value
        return 0.0 < gap <= TIE * self.apart(other) and not self.not_worse_than(other)

    def apart(self, other: Standing) -> float:
        """Standard error of the paired difference."""
        return error_of(self.influence - other.influence)


def beaten(one: Standing, everyone: Sequence[Standing]) -> bool:
    """Whether a cheaper filter is not worse, or one of the same price is better."""
    return any(
        other.not_worse_than(one)
        and (
            other.price < one.price or (other.price == one.price and not one.not_worse_than(other))
        )
        for other in everyone
        if other is not one
    )


def recommended(everyone: Sequence[Standing], nees: dict[str, Estimate]) -> tuple[str, str]:
    """The cheapest of those whose error is not worse than the smallest, and why."""
    best = everyone[0]
    ties = [one for one in everyone if one.not_worse_than(best)]
    chosen = min(ties, key=lambda one: one.price)
    about = f"its mean squared error, {_of(chosen)} times that of the genie,"
    if len(everyone) == 1:
        why = f"{about} has nothing to be compared with"
    elif chosen is not best:
        share = chosen.footprint.cost / max(1, best.footprint.cost)
        why = (
            f"{about} is that of {best.label} within {TIE:g} standard errors (difference "
            f"{_gap(chosen, best)}), at {share:.0%} of the operations"
        )
    elif len(ties) > 1:
        names = " and ".join(one.label for one in ties if one is not best)
        why = f"{about} is the smallest, and {names}, which may be as good, costs no less"
    else:
        second = everyone[1]
        why = f"{about} is the smallest, {_gap(second, best)} below that of {second.label}"
        if second.undecided_against(best):
            why += ", which more trials would have to decide"
    return chosen.label, f"Take {chosen.label}: {why}{_caution(nees[chosen.label])}."


def _gap(worse: Standing, better: Standing) -> Estimate:
    return Estimate(worse.value - better.value, worse.apart(better))


def _of(one: Standing) -> Estimate:
    return Estimate(one.value, error_of(one.influence))


def _caution(nees: Estimate) -> str:
    """A clause about a covariance that is not to be believed."""
    away = abs(nees.value - 1.0)
    if not away > max(HONEST, TIE * nees.error):
        return ""
    word = "too small" if nees.value > 1.0 else "too large"
    return f"; the covariance that it states is {word} (NEES {nees})"
