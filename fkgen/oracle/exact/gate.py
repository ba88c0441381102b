"""The best linear estimate from the measurements that pass a gate, from one joint distribution."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.oracle.exact.batch import BatchResult, Delays, Judged, measured, project
from fkgen.oracle.exact.gaussian import Array
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.textbook.mkf import scaled_pseudo_inverse

#: Share of its variance below which a row is what the rows before it say, up to rounding.
NO_NEWS = 1e-12

Flags: TypeAlias = NDArray[np.bool_]
Rows: TypeAlias = NDArray[np.intp]


@dataclass(frozen=True, eq=False, kw_only=True)
class GatedResult(BatchResult):
    """Estimates without the rows that are `rejected`; nis and likelihood are of the others."""

    rejected: Array  # (T, p): 1 or 0


def batch_gated(
    system: LinearSystem,
    y: Array,
    u: Array | None,
    probability: float,
    *,
    together: bool,
    delays: Delays | None = None,
) -> GatedResult:
    """Project on what passes: rows one after the other, or all finite ones of a sample together.

    Row i is compared with what the past and the accepted rows before it let expect.
    """

    def judge(k: int, innovation: Array, S: Array) -> Judged:
        rejected = outliers(innovation, S, probability, together=together)
        kept = np.flatnonzero(np.isfinite(innovation) & ~rejected)
        values: dict[str, ArrayLike] = {
            "rejected": rejected * 1.0,
            "nis": _distance(innovation, S, kept),
            "log_likelihood": _log_density(innovation, S, kept),
        }
        return values, (k, rejected)

    return GatedResult.of(project(*measured(system, y, u, delays), judge))


def outliers(innovation: Array, S: Array, probability: float, *, together: bool) -> Flags:
    """Which rows of an innovation of covariance S lie outside a probability, (p,)."""
    return (_whole if together else _rows)(innovation, S, probability)


def _distance(innovation: Array, S: Array, rows: Rows) -> float:
    """Normalised square of some rows."""
    r = innovation[rows]
    return float(r @ scaled_pseudo_inverse(S[np.ix_(rows, rows)]) @ r) if rows.size else 0.0


def _log_density(innovation: Array, S: Array, rows: Rows) -> float:
    """Gaussian log density of some rows."""
    if not rows.size:
        return 0.0
    determinant = float(np.linalg.slogdet(2.0 * np.pi * S[np.ix_(rows, rows)])[1])
    return -0.5 * (_distance(innovation, S, rows) + determinant)


def _whole(innovation: Array, S: Array, probability: float) -> Flags:
    from scipy.stats import chi2  # noqa: PLC0415 - slow to import

    rows = np.flatnonzero(np.isfinite(innovation))
    limit = chi2.ppf(probability, max(1, rows.size))
    return np.asarray(np.isfinite(innovation) & (_distance(innovation, S, rows) > limit))


def _rows(innovation: Array, S: Array, probability: float) -> Flags:
    from scipy.stats import norm  # noqa: PLC0415 - slow to import

    accepted: list[int] = []
    rejected = np.zeros(innovation.shape, bool)
    for i in np.flatnonzero(np.isfinite(innovation)):
        known = S[i, accepted] @ scaled_pseudo_inverse(S[np.ix_(accepted, accepted)])
        error = innovation[i] - known @ innovation[accepted]
        variance = S[i, i] - known @ S[accepted, i]
        if variance <= NO_NEWS * S[i, i]:
            continue
        if abs(error) > norm.ppf(0.5 + 0.5 * probability) * np.sqrt(variance):
            rejected[i] = True
        else:
            accepted.append(int(i))
    return rejected
