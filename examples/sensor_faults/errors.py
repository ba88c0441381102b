"""Squared errors over runs and samples, and what they are with their standard errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from section_vi import Floats

REST = slice(50, None)  # samples 50 to 100: the start is forgotten


@dataclass(frozen=True)
class Estimate:
    """A number and its standard error."""

    value: float
    error: float

    def __format__(self, form: str) -> str:
        return f"{self.value:{form or '.4f'}} +- {self.error:{form or '.4f'}}"

    @property
    def z(self) -> float:
        """The number in units of its standard error."""
        return self.value / self.error if self.error else 0.0


def mean(each: Floats) -> Estimate:
    """Mean over runs (M,)."""
    return Estimate(float(each.mean()), float(each.std(ddof=1) / np.sqrt(len(each))))


def ratio(upper: Floats, lower: Floats) -> Estimate:
    """Ratio of two means over the same runs (M,), its error by the delta method."""
    value = float(upper.mean() / lower.mean())
    return Estimate(value, mean(upper - value * lower).error / float(lower.mean()))


@dataclass(frozen=True)
class Errors:
    """What one filter did to all runs.

    Attributes
    ----------
    squared : (M, T) ndarray
        Squared errors of x(k|k).
    weighed : (M,) ndarray
        Normalised squared errors of each run, mean of samples 50 to 100.
    believed : float
        Mean of the variance that the filter states, samples 50 to 100.
    """

    squared: Floats
    weighed: Floats
    believed: float

    @classmethod
    def of(cls, truth: Floats, state: Floats, variance: Floats) -> Errors:
        """Compare estimates (M, T) with the truth."""
        squared = (truth - state) ** 2
        weighed = (squared[:, REST] / variance[:, REST]).mean(axis=1)
        return cls(squared, weighed, float(variance[:, REST].mean()))

    @property
    def each(self) -> Floats:
        """(M,): mean squared error of each run, samples 50 to 100."""
        return np.asarray(self.squared[:, REST].mean(axis=1))

    @property
    def mse(self) -> Estimate:
        """Mean squared error, samples 50 to 100."""
        return mean(self.each)

    @property
    def nees(self) -> Estimate:
        """Mean normalised squared error; 1 for a filter that knows how good it is."""
        return mean(self.weighed)

    def over(self, genie: Errors) -> Estimate:
        """Mean squared error over that of the genie, samples 50 to 100."""
        return ratio(self.each, genie.each)

    def over_at(self, genie: Errors, k: int) -> Estimate:
        """The same in sample k."""
        return ratio(self.squared[:, k], genie.squared[:, k])

    def over_time(self, genie: Errors) -> Floats:
        """(T - 1,): the same in samples 1, 2, ...; in sample 0 nobody errs."""
        means = self.squared.mean(axis=0)[1:], genie.squared.mean(axis=0)[1:]
        return np.asarray(means[0] / means[1])
