"""Tests whether a sample holds a signal, from densities and quantiles as they are defined.

Rules of the filter ``mjls_lmmse``; a tie is no loss, and a sample without a row is no test.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from fkgen.closed_form.gaussian import Array
from fkgen.spec import Filter


@dataclass(slots=True, kw_only=True)
class LossTest:
    """One of the rules, with what it remembers.

    Attributes
    ----------
    options : Filter
        Rule and thresholds.
    rate : float
        Pr(a sample holds a signal), for ``llr``.
    energies : list of float
        Past |r|^2, for ``energy``.
    """

    options: Filter
    rate: float
    energies: list[float] = field(default_factory=list)

    def judge(self, y: Array, residual: Array, S: Array, R: Array) -> tuple[float, float]:
        """Statistic and threshold of one sample; a loss is declared if the first is larger.

        Parameters
        ----------
        y, residual : (m,) ndarray
            Rows present, and their difference from the prediction.
        S, R : (m, m) ndarray
            Covariance of the residual if there is a signal, of y if there is none.
        """
        match self.options.detector:
            case "nis":
                from scipy.stats import chi2  # noqa: PLC0415 - slow to import

                nis = float(residual @ np.linalg.pinv(S, hermitian=True) @ residual)
                return nis, float(chi2.isf(self.options.alpha, len(y)))
            case "energy":
                self.energies.append(float(residual @ residual))
                mean = float(np.mean(self.energies[-self.options.window :]))
                return mean, self.options.kappa * float(np.trace(S))
        return self._log_odds(y, residual, S, R), 0.0

    def _log_odds(self, y: Array, residual: Array, S: Array, R: Array) -> float:
        """Log of the probability of a loss over that of a signal, given y and the past."""
        from scipy.stats import multivariate_normal  # noqa: PLC0415 - slow to import

        if self.rate in {0.0, 1.0}:
            return np.inf if self.rate == 0.0 else -np.inf
        zero = np.zeros(len(y))
        lost = np.log1p(-self.rate) + multivariate_normal.logpdf(y, zero, R)
        arrived = np.log(self.rate) + multivariate_normal.logpdf(residual, zero, S)
        return float(lost - arrived)
