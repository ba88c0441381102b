"""What a fault does to an estimate, sample by sample, and the power of chi-square tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError
from fkgen.runtime.record import probability

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class FaultEffect:
    """The difference that a fault makes, over T samples.

    n counts numbers of errors: of an attitude three, a rotation vector in body axes.

    Attributes
    ----------
    state_deviation : (T, n) ndarray
        Change of the filtered state x(k|k).
    error_deviation : (T, n) ndarray
        Change of the error x[k] - x(k|k): of the state less that of its estimate.
    innovation_deviation : (T, p) ndarray
        Change of the innovation; NaN where the row is missing.
    noncentrality : (T,) ndarray
        dr' S^-1 dr over the rows present: the NIS is noncentral chi-square with it. If ``paired``:
        the mean change of the NIS, which for a linear filter is the same number.
    state_sd : (T, n) ndarray
        Standard deviation of x(k|k) that the filter states, to measure the deviation by.
    degrees : (T,) ndarray of int
        Rows of y present, the degrees of freedom of the NIS.
    kind : str
        ``"exact"``: of every run, whatever the noise is. ``"mean"``: on average over lost commands,
        which decide how much of an input fault arrives. ``"paired"``: the mean over simulated runs
        with and without the fault, same noise in both; the filter is not linear in y, so the
        deviation depends on the run.
    standard_error : (T, n) ndarray
        Of `state_deviation`; zero unless ``paired``.
    runs : int
        Simulated pairs; 0 unless ``paired``.
    gaussian : bool
        Whether the NIS can be taken for chi-square, so that it has a `power`: for ``kf`` and
        ``genie``; for ``mkf`` without D nearly so, lost commands being noise of the same moments.
    """

    state_deviation: Array
    error_deviation: Array
    innovation_deviation: Array
    noncentrality: Array
    state_sd: Array
    degrees: NDArray[np.int64]
    kind: str
    standard_error: Array
    runs: int = 0
    gaussian: bool = True

    def __repr__(self) -> str:
        peak = ", ".join(f"{size:.3g}" for size in np.abs(self.error_deviation).max(axis=0))
        return f"<FaultEffect over {len(self.degrees)} samples, {self.kind}: errors up to {peak}>"

    def power(self, false_alarm: float) -> Array:
        """Probability that the NIS of one sample exceeds its bound, (T,).

        Parameters
        ----------
        false_alarm : float
            Probability that it does so without a fault.

        Raises
        ------
        DataError
            If the probability is not in (0, 1), or the NIS of this filter is not chi-square.
        """
        if not self.gaussian:
            given = "a filter whose innovation is a mixture"
            expected = "a filter whose innovation is Gaussian, or nearly so"
            raise DataError("power of the NIS test", given=given, expected=expected)
        alarms = probability("false_alarm", false_alarm)
        return detection_power(self.noncentrality, self.degrees, alarms)

    def settled(self, fraction: float) -> NDArray[np.int64]:
        """First sample from which on a state's error stays below a share of its peak, (n,).

        T where it does not get there within the record; 0 where there is no effect at all.

        Parameters
        ----------
        fraction : float
            Of the peak of ``abs(error_deviation)``, in (0, 1), or a `DataError`.
        """
        share = probability("fraction", fraction)
        size = np.abs(self.error_deviation)
        peak = size.max(axis=0)
        above = size > share * peak
        after = len(size) - np.argmax(above[::-1], axis=0)
        return np.asarray(np.where(peak > 0.0, after, 0), dtype=np.int64)


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
