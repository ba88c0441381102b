"""Detection rate against false alarm rate, by thresholds of the probability of a mode."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fkgen.study.campaigns.sums import Statistic, Sums
from fkgen.study.campaigns.tally import THRESHOLDS

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Roc:
    """Receiver operating characteristics of modes: i is declared where its probability is high.

    Attributes
    ----------
    threshold : (K,) ndarray
        Mode i is declared at a sample where its probability given y up to there is at least that;
        at the first one, 0, always.
    detection : Statistic, (N, K)
        Share of the samples in mode i at which i is declared.
    false_alarm : Statistic, (N, K)
        Share of the samples in other modes at which i is declared.
    area : Statistic, (N,)
        Under the line through these points and (0, 0): 1 if the probability tells mode i from the
        others, 1/2 if it knows nothing.

    N is 0 where the filter has no modes, or others than the plant. NaN where no sample counts.
    """

    threshold: Array
    detection: Statistic
    false_alarm: Statistic
    area: Statistic

    @property
    def facts(self) -> dict[str, Any]:
        """Everything, by the names of the attributes."""
        rates = {key: getattr(self, key)._asdict() for key in ("detection", "false_alarm", "area")}
        return {"threshold": self.threshold, **rates}


def roc_of(sums: Sums) -> Roc:
    """What the counts say.

    Trials are independent, samples of one are not. With counts x of a trial (samples of other
    modes by the highest threshold that is reached, then those of the mode itself), their sums s and
    sums S of x x', a function f(s) that does not change with the scale of s has the variance
    M/(M - 1) g' S g to first order, where g is its gradient: g' s = 0.
    """
    wide = 2 * len(THRESHOLDS)
    each = wide + wide * (wide + 1) // 2
    found = [_of_mode(some, sums.trials) for some in sums.counts.reshape(-1, each)]
    table = np.array(found).reshape(-1, 2, wide + 1)
    parts = (slice(0, wide // 2), slice(wide // 2, wide), wide)
    false_alarm, detection, area = (Statistic(table[:, 0, p], table[:, 1, p]) for p in parts)
    return Roc(np.array(THRESHOLDS), detection, false_alarm, area)


def _of_mode(counts: Array, trials: int) -> Array:
    """(2, 2 K + 1): rates of false alarm, of detection, and the area; and their errors."""
    K = len(THRESHOLDS)
    s, packed = counts[: 2 * K], counts[2 * K :]
    S = np.zeros((2 * K, 2 * K))
    S[np.tril_indices(2 * K)] = packed
    S = np.where(np.tri(2 * K) > 0.0, S, S.T)
    value, gradient = np.full(2 * K + 1, np.nan), np.full((2 * K + 1, 2 * K), np.nan)
    total = np.repeat([math.fsum(s[:K]), math.fsum(s[K:])], K)
    shares = np.divide(s, total, out=np.full(2 * K, np.nan), where=total > 0.0)
    above = np.tri(K).T  # those that reach a threshold
    for part in (slice(0, K), slice(K, 2 * K)):
        if total[part][0] > 0.0:
            value[part] = [math.fsum(s[part][k:]) / total[part][0] for k in range(K)]
            gradient[part] = 0.0
            gradient[part, part] = (above - value[part, np.newaxis]) / total[part][0]
    others, own = shares[:K], shares[K:]
    if np.isfinite(shares).all():
        below = np.array([math.fsum([*others[:k], 0.5 * others[k]]) for k in range(K)])
        beyond = np.array([math.fsum([*own[k + 1 :], 0.5 * own[k]]) for k in range(K)])
        value[-1] = math.fsum(own * below)
        gradient[-1] = (np.concatenate([beyond, below]) - value[-1]) / total
    return np.array([value, [_error(g, S, trials) for g in gradient]])


def _error(gradient: Array, S: Array, trials: int) -> float:
    if trials < 2 or not np.isfinite(gradient).all():
        return math.nan
    square = math.fsum((np.outer(gradient, gradient) * S).ravel().tolist())
    return math.sqrt(max(0.0, square) * trials / (trials - 1))
