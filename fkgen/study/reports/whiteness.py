"""Whether innovations are white: their correlations by lag, and how probable larger ones are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Correlations are looked at up to this lag, and against this quantile of white noise.
LAGS, NORMAL = 20, 1.96


@dataclass(frozen=True, slots=True, eq=False)
class Correlations:
    """Of innovations over their standard deviations, row by row.

    A lag counts in measurements of the row, which need not come at every sample: those of a filter
    that is right are white however they come.

    Attributes
    ----------
    products : (p, LAGS + 1) ndarray
        Sums of products of numbers that lie 0, 1, ... measurements apart.
    count : (p,) ndarray
        Numbers that they are of.
    """

    products: Array
    count: Array

    @property
    def value(self) -> Array:
        """(p, LAGS): the correlations; 0 where there is nothing to be correlated."""
        power = self.products[:, :1]
        found = np.zeros_like(self.products[:, 1:])
        return np.asarray(np.divide(self.products[:, 1:], power, out=found, where=power > 0.0))

    @property
    def bound(self) -> Array:
        """(p,): 19 of 20 correlations of white noise are smaller."""
        return np.asarray(NORMAL / np.sqrt(np.maximum(self.count, 1.0)))

    @property
    def probability(self) -> Array:
        """(p,): of larger correlations in white noise (Ljung & Box 1978)."""
        from scipy.special import chdtrc  # noqa: PLC0415 - scipy takes long to import

        N, lags = self.count[:, None], np.arange(1, LAGS + 1)
        terms = self.value**2 / np.maximum(N - lags, 1.0)
        return np.asarray(chdtrc(LAGS, (N * (N + 2.0) * terms).sum(axis=1)))

    def plus(self, other: Correlations) -> Correlations:
        """Of both, neither of which goes on where the other one ends."""
        return Correlations(self.products + other.products, self.count + other.count)


def correlations(
    innovation: NDArray[np.floating], covariance: NDArray[np.floating] | None
) -> Correlations:
    """Correlations of innovations (M, T, p) with covariances (M, T, p, p); NaN = missing."""
    normal = np.asarray(innovation, np.float64)
    if covariance is not None:
        variance = np.diagonal(covariance, axis1=2, axis2=3).astype(np.float64)
        normal = normal / np.sqrt(np.where(variance > 0.0, variance, np.nan))
    products, count = np.zeros((normal.shape[2], LAGS + 1)), np.zeros(normal.shape[2])
    for record in normal:
        for i, row in enumerate(record.T):
            there = row[np.isfinite(row)]
            count[i] += len(there)
            for lag in range(min(LAGS + 1, len(there))):
                products[i, lag] += there[lag:] @ there[: len(there) - lag]
    return Correlations(products, count)
