"""Means over independent trials, with what is known of their error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Estimate:
    """A number and its standard error."""

    value: float
    error: float

    def __str__(self) -> str:
        """The number with as many digits as its error leaves meaning."""
        if not np.isfinite(self.value):
            return "-"
        if not self.error > 0.0:
            return f"{self.value:.4g}"
        digits = int(np.clip(1 - np.floor(np.log10(self.error)), 0, 8))
        return f"{self.value:.{digits}f} +- {self.error:.{digits}f}"


UNKNOWN = Estimate(float("nan"), float("nan"))


def mean(each: Array) -> Estimate:
    """The mean over trials, of (M,) numbers; NaN where a trial has nothing to say."""
    known = each[np.isfinite(each)]
    if not known.size:
        return UNKNOWN
    return Estimate(float(known.mean()), error_of(known - known.mean()))


def ratio(above: Array, below: Array) -> Estimate:
    """The ratio of two means over the same trials, with its error by the delta method."""
    value, influence = influence_of(above, below)
    return Estimate(value, error_of(influence))


def influence_of(above: Array, below: Array) -> tuple[float, Array]:
    """A ratio of means, and how far each trial moves it: (M,), with mean zero.

    Differences of ratios have the differences of these: that is what pairing trials gains.
    """
    total = float(below.mean())
    if not total > 0.0:
        return float("nan"), np.full(above.shape, np.nan)
    value = float(above.mean()) / total
    return value, (above - value * below) / total


def error_of(influence: Array) -> float:
    """Standard error of the mean of numbers with mean zero, one per trial."""
    if influence.size < 2:
        return float("nan")
    return float(np.sqrt((influence**2).sum() / (influence.size - 1) / influence.size))
