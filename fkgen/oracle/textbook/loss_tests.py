"""Tests whether a sample holds a signal: a tie is no loss, a sample without a row is no test."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fkgen.oracle.exact.gaussian import Array, log_density, square_root, whiten

#: The ports of a detector.
VERDICT = (
    *("fault_declared", "test_statistic", "test_threshold", "test_dof"),
    "consecutive_rejections",
)


@dataclass(slots=True, kw_only=True)
class LossTest:
    """One of the rules, with what it remembers."""

    options: Any  # detector and its thresholds
    rate: float  # Pr(a sample holds a signal), for llr
    rates: Array | None = None  # The same of every sample, where it is not one for all
    samples: int = 0  # How many were seen
    energies: list[float] = field(default_factory=list)  # Past |r|^2, for energy
    run: int = 0  # Rejections in a row

    def judge(self, y: Array, residual: Array, S: Array, R: Array) -> tuple[float, float]:
        """Statistic and threshold of one sample; y, residual (m,); S, R (m, m)."""
        match self.options.detector:
            case "nis":
                from scipy.special import chdtri  # noqa: PLC0415 - slow to import

                nis = float(np.sum((whiten(square_root(S)).weights @ residual) ** 2))
                return nis, float(chdtri(len(y), self.options.alpha))
            case "energy":
                self.energies.append(float(residual @ residual))
                mean = float(np.mean(self.energies[-self.options.window :]))
                return mean, self.options.kappa * float(np.trace(S))
        return self._log_odds(y, residual, S, R), 0.0

    def _log_odds(self, y: Array, residual: Array, S: Array, R: Array) -> float:
        """Log of the probability of a loss over that of a signal, given y and the past."""
        rate = self.rate if self.rates is None else float(self.rates[self.samples])
        if rate in {0.0, 1.0}:
            return np.inf if rate == 0.0 else -np.inf
        lost = np.log1p(-rate) + log_density(y, whiten(square_root(R)))
        arrived = np.log(rate) + log_density(residual, whiten(square_root(S)))
        return float(lost - arrived)

    def restarts(self, *, fault: bool) -> bool:
        """Count one verdict; whether the rejections in a row have become too many."""
        before = 0 if self._locked else self.run
        self.run = before + 1 if fault else 0
        if self._locked:
            self.energies.clear()
        return self._locked

    @property
    def _locked(self) -> bool:
        return bool(self.options.reinitialise and self.run >= self.options.lock_out)


def verdict(
    test: LossTest | None, y: Array, residual: Array, S: Array, R: Array
) -> tuple[dict[str, float], bool]:
    """What the test says of the finite rows of a sample, as ports, and whether to start again."""
    values, restart, rows = (0.0,) * 4, False, np.flatnonzero(np.isfinite(y))
    if test is not None and rows.size:
        chosen = np.ix_(rows, rows)
        statistic, threshold = test.judge(y[rows], residual[rows], S[chosen], R[chosen])
        fault = statistic > threshold
        restart = test.restarts(fault=fault)
        values = (float(fault), statistic, threshold, float(rows.size))
    if test is not None:
        test.samples += 1
    rejections = float(test.run if test else 0)
    return dict(zip(VERDICT, (*values, rejections), strict=True)), restart
