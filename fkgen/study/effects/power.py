"""Chi-square tests and faults: what noncentrality a test needs, what power it has."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError
from fkgen.problem.numbers import probability

Array = NDArray[np.float64]


def required_noncentrality(degrees: int, false_alarm: float, power: float) -> float:
    """The noncentrality at which a chi-square test has a given power above its false alarm rate."""
    from scipy.optimize import brentq  # noqa: PLC0415 - slow to import
    from scipy.stats import chi2, ncx2  # noqa: PLC0415 - slow to import

    alarm, wanted = probability("false_alarm", false_alarm), probability("power", power)
    if wanted <= alarm:
        expected = f"more than false_alarm = {alarm:g}: without any fault a test has that power"
        raise DataError("power", given=f"{wanted:g}", expected=expected)
    bound = float(chi2.isf(alarm, degrees))

    def missing(noncentrality: float) -> float:
        return float(ncx2.sf(bound, degrees, noncentrality)) - wanted

    high = 1.0
    while missing(high) < 0.0:
        high *= 2.0
    return float(brentq(missing, 0.0, high, xtol=1e-12, rtol=1e-14))


def detection_power(noncentrality: Array, degrees: NDArray[np.int64], false_alarm: float) -> Array:
    """Power of chi-square tests, (T,), one per sample; 0 where there is nothing to test."""
    from scipy.stats import chi2, ncx2  # noqa: PLC0415 - slow to import

    used = np.maximum(degrees, 1)
    found = ncx2.sf(chi2.isf(false_alarm, used), used, noncentrality)
    return np.asarray(np.where(degrees > 0, found, 0.0))
