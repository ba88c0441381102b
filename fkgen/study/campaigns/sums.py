"""Sums over trials that do not depend on the order in which they were added up.

A sum of doubles is held exactly, as a few numbers of decreasing size (Shewchuk 1997, "Adaptive
precision floating-point arithmetic", expansions): each is what is left of the sum of those before
it, rounded correctly. So it is a function of the exact sum alone, and adding two of them is exact.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError

Array = NDArray[np.float64]
_ROUNDED = Fraction(1, 2**50)
_WHOLE = 2.0**52  # whole numbers whose sizes sum up to less are added without rounding
_LARGEST = 1e290  # of a sum, so that sums of them do not overflow
_SUMS = 5  # of a, b, a a, a b, b b: what a ratio of means and its standard error need


class Statistic(NamedTuple):
    """Estimates and their standard errors, which have the same shape."""

    value: Array
    standard_error: Array


@dataclass(frozen=True, slots=True, eq=False)
class Sums:
    """What is known of some trials.

    Attributes
    ----------
    trials : int
    shapes : mapping of str to tuple
        Ratios by name.
    parts : (P, K) ndarray
        The exact sums: one of all numbers of all ratios, five times; then those of counts.
    """

    trials: int
    shapes: Mapping[str, tuple[int, ...]]
    parts: Array

    @classmethod
    def of(cls, trials: int, shapes: Mapping[str, tuple[int, ...]], sums: Array) -> Sums:
        """The sums (5 N + counts,) of a block; they are rounded, always in the same order.

        Raises
        ------
        DataError
            If a square overflows.
        """
        if not np.abs(sums).max(initial=0.0) < _LARGEST:
            expected = "errors that can be squared: plant or filter are not stable"
            raise DataError("steps", given="errors whose squares overflow", expected=expected)
        return cls(trials, shapes, sums.reshape(1, -1))

    def ratio(self, name: str) -> Statistic:
        """Sum of a over sum of b, with the standard error of a ratio of means (delta method).

        Trials are independent, samples of one are not: the error is from the spread of trials. NaN
        where b is 0 throughout, and the error of a single trial.
        """
        shape = self.shapes[name]
        exact = [
            [sum(map(Fraction, parts), Fraction()) for parts in sums]
            for sums in self._columns(name).T.tolist()
        ]
        value, error = np.array([_ratio(each, self.trials) for each in exact]).reshape(-1, 2).T
        return Statistic(value.reshape(shape)[()], error.reshape(shape)[()])

    def total(self, name: str) -> Array:
        """Sum of b."""
        found = [math.fsum(parts) for parts in self._columns(name)[:, 1].T.tolist()]
        return np.array(found).reshape(self.shapes[name])

    def _columns(self, name: str) -> Array:
        """The parts of five sums of each number, (P, 5, size)."""
        widths = [math.prod(shape) for shape in self.shapes.values()]
        place = list(self.shapes).index(name)
        start, total = sum(widths[:place]), _SUMS * sum(widths)
        every = self.parts[:, :total].reshape(len(self.parts), _SUMS, -1)
        return every[:, :, start : start + widths[place]]

    @property
    def counts(self) -> Array:
        """Sums of counts, which belong to no ratio, rounded correctly."""
        return self.parts[0, _SUMS * sum(map(math.prod, self.shapes.values())) :]


def _ratio(sums: Sequence[Fraction], trials: int) -> tuple[float, float]:
    a, b, aa, ab, bb = sums
    if not b:
        return math.nan, math.nan
    r = a / b
    if trials < 2:
        return float(r), math.nan
    left = aa - 2 * r * ab + r * r * bb
    if left <= _ROUNDED * aa:  # the squares were rounded: nothing is left but that
        return float(r), 0.0
    return float(r), math.sqrt(left * Fraction(trials, trials - 1) / (b * b))


def merged(sums: Iterable[Sums]) -> Sums:
    """The sums of several sets of trials as those of all of them, exactly."""
    every = list(sums)
    if len(every) == 1:
        return every[0]
    numbers = np.concatenate([each.parts for each in every])
    total = numbers.sum(axis=0) + 0.0
    exact = (np.abs(numbers).sum(axis=0) < _WHOLE) & (numbers == np.rint(numbers)).all(axis=0)
    others = np.flatnonzero(~exact)
    expansions = [_expansion(column) for column in numbers[:, others].T.tolist()]
    parts = np.zeros((max(map(len, expansions), default=1), len(total)))
    parts[0] = total
    for i, found in zip(others, expansions, strict=True):
        parts[: len(found), i] = found
    return Sums(sum(each.trials for each in every), every[0].shapes, parts)


def _expansion(numbers: list[float]) -> list[float]:
    """Numbers of decreasing size whose exact sum is that of others: at least one."""
    found = [math.fsum(numbers)]
    while rest := math.fsum([*numbers, *(-each for each in found)]):
        found.append(rest)
    return found
