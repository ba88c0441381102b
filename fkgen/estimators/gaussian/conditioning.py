"""Condition a Gaussian prior on the rows of y that are present, one scalar update per row.

No matrix is inverted: a row costs one reciprocal. Correlated measurement noise is first
decorrelated by LDL' elimination over the rows that are present, so that a missing row leaves R as
well.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from fkgen.estimators.gaussian.decorrelation import Measurement, decorrelate
from fkgen.estimators.gaussian.sequential import Form, SequentialUpdate
from fkgen.symbolic.builder import Script
from fkgen.symbolic.linalg import column, congruence, operations, pack

#: A row is redundant when its pivot is below this share of its prior variance (rank decision).
RANK_TOLERANCE = {"double": 2e-13, "float": 1e-4}

#: Pivots that are multiplied before the logarithm: in double each may span 1e-75 to 1e75.
PIVOTS_PER_LOG = {"double": 4, "float": 1}


@dataclass(frozen=True, slots=True, kw_only=True)
class Conditioned:
    """What one measurement says; NIS and log-likelihood are about the rows present."""

    mean: ca.SX  # (m,)
    covariance: ca.SX  # packed
    innovation: ca.SX  # (p,), zero where the row is missing
    innovation_covariance: ca.SX  # packed, of all rows, present or not
    nis: ca.SX
    log_likelihood: ca.SX
    gain: ca.SX | None  # (m, p), d mean / d y, columns of missing rows zero


def condition(
    script: Script,
    prior: tuple[ca.SX, ca.SX],
    measurement: Measurement,
    *,
    tag: str = "",
    form: Form,
    with_gain: bool = False,
    innovation: list[ca.SX] | None = None,
) -> Conditioned:
    """Write the blocks that condition ``prior``, mean and covariance, on ``measurement``.

    An ``innovation`` that is there already is zero where its row is missing.
    """
    (mean, covariance), (p, m) = prior, measurement.C.shape
    if innovation is None:
        innovation = innovations(script, mean, measurement, tag)
    variance = _variance(script, covariance, measurement, tag)
    rows = decorrelate(script, measurement, innovation, tag)
    packed = pack(covariance)
    start = {f"mean{tag}": mean, f"covariance{tag}": packed}
    symbols = {name: script.local(name, value.numel()) for name, value in start.items()}
    script.put(start)
    update = SequentialUpdate(
        script=script,
        rows=rows,
        at=measurement.at,
        tag=tag,
        form=form,
        variance=variance,
        rank_tolerance=measurement.rank_tolerance,
        prior=mean,
        mean=mean,
        covariance=packed,
        gain=ca.SX(m, p) if with_gain else None,
        determinant=[ca.SX(1)] * -(-p // measurement.pivots_per_log),
        symbols=symbols,
    )
    for i in range(p):
        with script.titled(f"row {measurement.at[i]} of y, {measurement.rows[i]}"):
            update.update_row(i)
    return Conditioned(
        mean=update.mean,
        covariance=update.covariance,
        innovation=column(innovation),
        innovation_covariance=update.innovation_covariance() if variance is None else variance,
        nis=update.nis,
        log_likelihood=-0.5 * (update.nis + update.log_determinant()),
        gain=update.gain,
    )


def _variance(
    script: Script, covariance: ca.SX, measurement: Measurement, tag: str
) -> ca.SX | None:
    """S = C P C' + R, packed; None if it comes cheaper from the factors of the row updates.

    With many rows and few states, products of rows with each other cost more than C P C'.
    """
    p, C = measurement.C.shape[0], measurement.C
    S = congruence(C, covariance) + pack(measurement.R)
    by_factors = p * (p - 1) * C.nnz() / p + 1.5 * p * (p - 1) + p**3 / 3
    diagonal = measurement.R.sparsity().is_diag()
    if diagonal and measurement.rank_tolerance is None and by_factors <= operations(S):
        return None
    return script.let(f"variance{tag}", S)


def innovations(script: Script, mean: ca.SX, measurement: Measurement, tag: str) -> list[ca.SX]:
    """Each row of y minus its prediction; zero where the row is missing."""
    result = []
    with script.titled("innovation, row by row"):
        for i in range(measurement.C.shape[0]):
            name = f"innovation{tag}_{i}"
            symbol = script.local(name, 1, initial=0.0)
            predicted = ca.mtimes(measurement.C[i, :], mean)
            with script.when(measurement.at[i]):
                script.put({name: measurement.y[i] - predicted - measurement.offset[i]})
            result.append(symbol)
    return result
