"""Condition a Gaussian prior on the rows of y that are present, one scalar update per row.

No matrix is inverted: a row costs one reciprocal. Correlated measurement noise is first
decorrelated by LDL' elimination over the rows that are present, so that a missing row leaves R as
well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca

from fkgen.estimators.gaussian.blocked import BlockedUpdate, is_blocked
from fkgen.estimators.gaussian.decorrelation import Decorrelation, Measurement, multiplied
from fkgen.estimators.gaussian.factored import FactoredUpdate
from fkgen.estimators.gaussian.gate import HALF, Gate
from fkgen.estimators.gaussian.rolled import Arrays, is_rolled, taken_in_loops
from fkgen.estimators.gaussian.rows import Form, SequentialUpdate
from fkgen.estimators.gaussian.ud import Factors, seen_through
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.linalg import column, operations, pack, reduced, total

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
    rejected: Sequence[ca.SX] = ()  # 1 for each row that a gate leaves out; empty without one
    factors: Factors | None = None  # Of the covariance, if that of the prior has factors


#: Mean and covariance, (m, m) or as factors.
Prior = tuple[ca.SX, ca.SX | Factors]


def condition(
    builder: PhaseBuilder,
    prior: Prior,
    measurement: Measurement,
    *,
    tag: str = "",
    form: Form,
    with_gain: bool = False,
    innovation: list[ca.SX] | None = None,
    gate: Gate | None = None,
) -> Conditioned:
    """Write the blocks that condition ``prior``, mean and covariance, on ``measurement``.

    An ``innovation`` that is there already is zero where its row is missing.
    """
    by_row = gate if gate is not None and not gate.together else None
    if isinstance(held := prior[1], Factors):
        innovation = innovation or innovations(builder, prior[0], measurement, tag)
        rows = _Rows(builder, measurement, tag, innovation)
        update = rows.taken((prior[0], held), form, by_row, with_gain=with_gain)
        found = _found(update, innovation, held)
        return found if gate is None or by_row else _gated(builder, gate, found, prior)
    prior = prior[0], held
    if is_blocked(measurement):
        blocked = BlockedUpdate(
            builder=builder, measurement=measurement, prior=prior, tag=tag, gate=by_row
        )
        if innovation is None and measurement.predicted is None:
            measurement = replace(measurement, predicted=blocked.expected())
        innovation = innovation or innovations(builder, prior[0], measurement, tag)
        found = _together(blocked, innovation, form, with_gain=with_gain)
        return found if gate is None or by_row else _gated(builder, gate, found, prior)
    innovation = innovation or innovations(builder, prior[0], measurement, tag)
    if is_rolled(measurement, with_gain=with_gain):
        arrays = Arrays(builder, measurement, tag, with_gain=with_gain)
        update = taken_in_loops(arrays, prior, innovation, form, by_row)
    else:
        rows = _Rows(builder, measurement, tag, innovation)
        update = rows.taken(prior, form, by_row, with_gain=with_gain)
    found = _found(update, innovation)
    return found if gate is None or by_row else _gated(builder, gate, found, prior)


def _found(
    update: SequentialUpdate, innovation: list[ca.SX], held: Factors | None = None
) -> Conditioned:
    """What rows said that were taken in one by one."""
    S, factors = update.variance, None
    if held is not None:
        factors = Factors.of(update.covariance, held.order, held.scalar)
    return Conditioned(
        mean=update.mean,
        covariance=update.covariance if factors is None else factors.covariance(),
        innovation=column(innovation),
        innovation_covariance=update.innovation_covariance() if S is None else S,
        nis=update.nis,
        log_likelihood=_log_likelihood(update.nis, update.log_constant, update.determinant),
        gain=update.gain,
        rejected=update.rejected,
        factors=factors,
    )


def _log_likelihood(nis: ca.SX, log_constant: ca.SX, determinant: Sequence[ca.SX]) -> ca.SX:
    """Of a Gaussian, whose determinant comes in factors."""
    return -0.5 * (nis + total([log_constant, *map(ca.log, determinant)]))


def _together(
    update: BlockedUpdate, innovation: list[ca.SX], form: Form, *, with_gain: bool
) -> Conditioned:
    """The prior with all rows, in products of matrices."""
    builder, (p, m) = update.builder, update.measurement.C.shape
    with builder.titled("covariance of the innovation"):
        S = update.innovation_covariance()
    with builder.titled("every row out of the rows below"):
        update.eliminate(innovation)
    gain = update.gain() if with_gain or form == "joseph" else None
    with builder.titled("all rows together"):
        covariance = update.joseph(gain) if form == "joseph" and gain else update.short()
        mean = update.mean()
    determinant = multiplied(update.pivots, update.measurement.pivots_per_log)
    K = None
    if gain is not None and with_gain:
        K = ca.SX(m, p)
        for i in range(m):
            for j in range(p):
                K[i, j] = builder.read(gain.at(j, i))
    return Conditioned(
        mean=mean,
        covariance=covariance,
        innovation=column(innovation),
        innovation_covariance=S,
        nis=update.nis,
        log_likelihood=_log_likelihood(update.nis, update.log_constant, determinant),
        gain=K,
        rejected=update.rejected,
    )


@dataclass(frozen=True, slots=True)
class _Rows:
    """A measurement that is taken in row by row, in straight lines."""

    builder: PhaseBuilder
    measurement: Measurement
    tag: str
    innovation: list[ca.SX]

    def taken(
        self, prior: Prior, form: Form, gate: Gate | None, *, with_gain: bool
    ) -> SequentialUpdate:
        """The prior with all rows; with a gate their noise leaves the rows below once they pass."""
        builder, measurement, (p, m) = self.builder, self.measurement, self.measurement.C.shape
        variance = _variance(builder, prior[1], measurement, self.tag)
        noise = Decorrelation(builder, measurement, self.innovation, self.tag)
        if gate is None:
            noise.eliminate_all()
        facts: dict[str, Any] = {
            "builder": builder,
            "rows": [noise.row(i) for i in range(p)],
            "at": measurement.at,
            "tag": self.tag,
            "form": form,
            "variance": variance,
            "rank_tolerance": measurement.rank_tolerance,
            "prior": prior[0],
            "gain": ca.SX(m, p) if with_gain else None,
            "pivots_per_log": measurement.pivots_per_log,
            "gate": gate,
            "kept": measurement.kept,
            "apart": measurement.apart,
        }
        update: SequentialUpdate
        if isinstance(held := prior[1], Factors):
            facts |= {"order": held.order, "scalar": held.scalar}
            update = FactoredUpdate(covariance=held.packed, **facts)
        else:
            update = SequentialUpdate(covariance=pack(held), **facts)
        for i, name in enumerate(measurement.rows):
            update.rows[i] = noise.row(i)
            with builder.titled(f"row {measurement.at[i]} of y, {name}"):
                update.update_row(i)
            if gate is not None:
                passed, counts = HALF - update.rejected[i], measurement.counts(i)
                noise.eliminate(i, passed if counts is None else ca.fmin(passed, counts))
        return update


def _gated(builder: PhaseBuilder, gate: Gate, found: Conditioned, prior: Prior) -> Conditioned:
    """What all rows say together, or the prior where they do not fit it."""
    held, factors = prior[1], found.factors
    both = (found.covariance, pack(held)) if isinstance(held, ca.SX) else (ca.SX(), ca.SX())
    if factors is not None and isinstance(held, Factors):
        both = factors.packed, held.packed
    values = {
        "mean": (found.mean, prior[0]),
        "covariance": both,
        "nis": (found.nis, ca.SX(0)),
        "log_likelihood": (found.log_likelihood, ca.SX(0)),
    }
    if found.gain is not None:
        values["gain"] = found.gain, ca.SX.zeros(found.gain.shape)
    with_rows, without = ({name: pair[at] for name, pair in values.items()} for at in (0, 1))
    rejected, kept = gate.sample(builder, found.nis, with_rows, without)
    if factors is not None:
        factors = Factors.of(kept["covariance"], factors.order, factors.scalar)
        kept["covariance"] = factors.covariance()
    return replace(found, rejected=rejected, factors=factors, **kept)


def _variance(
    builder: PhaseBuilder, covariance: ca.SX | Factors, measurement: Measurement, tag: str
) -> ca.SX | None:
    """S = C P C' + R, packed; None if it comes cheaper from the factors of the row updates.

    With many rows and few states, products of rows with each other cost more than C P C'. Where S
    is not shown, C drops it, and innovations that are corrected through the mean cost least.
    """
    C, R = measurement.C, measurement.R
    p, S = C.shape[0], seen_through(C, covariance) + pack(R)
    by_factors = p * (p - 1) * C.nnz() / p + 1.5 * p * (p - 1) + p**3 / 3
    decided = R.sparsity().is_diag() and measurement.rank_tolerance is None
    few = bool(measurement.apart) or by_factors <= operations(S)
    if decided and measurement.shows_variance and few:
        return None
    return builder.define(f"variance{tag}", S)


def innovations(
    builder: PhaseBuilder, mean: ca.SX, measurement: Measurement, tag: str
) -> list[ca.SX]:
    """Each row of y minus its prediction; zero where the row is missing."""
    result, seen = [], measurement.predicted
    with builder.titled("innovation, row by row"):
        for i in range(measurement.C.shape[0]):
            name = f"innovation{tag}_{i}"
            result.append(builder.local(name, 1, initial=0.0))
            predicted = ca.mtimes(measurement.C[i, :], mean) if seen is None else seen[i]
            value = measurement.y[i] - predicted - measurement.offset[i]
            with builder.if_present(measurement.at[i], measurement.counts(i)):
                builder.assign({name: reduced(value) if i in measurement.wraps else value})
    return result
