"""Condition a Gaussian prior on the rows of y that are present, one scalar update per row.

No matrix is inverted: a row costs one reciprocal. Correlated measurement noise is first
decorrelated by LDL' elimination over the rows that are present, so that a missing row leaves R as
well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import InitVar, dataclass, field, replace
from typing import Literal

import casadi as ca

from fkgen.estimators.gaussian.decorrelation import LOG_TWO_PI, Decorrelation, Measurement, Row
from fkgen.estimators.gaussian.gate import HALF, Gate
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.interface import Kind, Status, triangle
from fkgen.symbolic.linalg import (
    column,
    congruence,
    diagonal,
    is_zero,
    operations,
    outer_lower,
    pack,
    reduced,
    total,
    unpack,
)

Form = Literal["short", "joseph"]

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


def condition(
    builder: PhaseBuilder,
    prior: tuple[ca.SX, ca.SX],
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
    (mean, covariance), (p, m) = prior, measurement.C.shape
    innovation = innovation or innovations(builder, mean, measurement, tag)
    variance = _variance(builder, covariance, measurement, tag)
    by_row = gate if gate is not None and not gate.together else None
    noise = Decorrelation(builder, measurement, innovation, tag)
    if by_row is None:
        noise.eliminate_all()
    update = SequentialUpdate(
        builder=builder,
        rows=[noise.row(i) for i in range(p)],
        at=measurement.at,
        tag=tag,
        form=form,
        variance=variance,
        rank_tolerance=measurement.rank_tolerance,
        prior=mean,
        covariance=pack(covariance),
        gain=ca.SX(m, p) if with_gain else None,
        pivots_per_log=measurement.pivots_per_log,
        gate=by_row,
    )
    _update_rows(builder, update, noise)
    found = Conditioned(
        mean=update.mean,
        covariance=update.covariance,
        innovation=column(innovation),
        innovation_covariance=update.innovation_covariance() if variance is None else variance,
        nis=update.nis,
        log_likelihood=-0.5
        * (update.nis + total([update.log_constant, *map(ca.log, update.determinant)])),
        gain=update.gain,
        rejected=update.rejected,
    )
    return found if gate is None or by_row else _gated(builder, gate, found, prior)


def _update_rows(builder: PhaseBuilder, update: SequentialUpdate, noise: Decorrelation) -> None:
    """Take all rows in; with a gate their noise leaves the rows below once they have passed."""
    for i, name in enumerate(noise.measurement.rows):
        update.rows[i] = noise.row(i)
        with builder.titled(f"row {noise.measurement.at[i]} of y, {name}"):
            update.update_row(i)
        if update.gate is not None:
            noise.eliminate(i, HALF - update.rejected[i])


def _gated(
    builder: PhaseBuilder, gate: Gate, found: Conditioned, prior: tuple[ca.SX, ca.SX]
) -> Conditioned:
    """What all rows say together, or the prior where they do not fit it."""
    values = {
        "mean": (found.mean, prior[0]),
        "covariance": (found.covariance, pack(prior[1])),
        "nis": (found.nis, ca.SX(0)),
        "log_likelihood": (found.log_likelihood, ca.SX(0)),
    }
    if found.gain is not None:
        values["gain"] = found.gain, ca.SX.zeros(found.gain.shape)
    with_rows, without = ({name: pair[at] for name, pair in values.items()} for at in (0, 1))
    rejected, kept = gate.sample(builder, found.nis, with_rows, without)
    return replace(found, rejected=rejected, **kept)


def _variance(
    builder: PhaseBuilder, covariance: ca.SX, measurement: Measurement, tag: str
) -> ca.SX | None:
    """S = C P C' + R, packed; None if it comes cheaper from the factors of the row updates.

    With many rows and few states, products of rows with each other cost more than C P C'. Where S
    is not shown, C drops it, and innovations that are corrected through the mean cost least.
    """
    C, R = measurement.C, measurement.R
    p, S = C.shape[0], congruence(C, covariance) + pack(R)
    by_factors = p * (p - 1) * C.nnz() / p + 1.5 * p * (p - 1) + p**3 / 3
    decided = R.sparsity().is_diag() and measurement.rank_tolerance is None
    if decided and measurement.shows_variance and by_factors <= operations(S):
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
            with builder.if_present(measurement.at[i]):
                builder.assign({name: reduced(value) if i in measurement.wraps else value})
    return result


@dataclass(slots=True, kw_only=True)
class SequentialUpdate:
    """Builder of the sequential update: the values so far, which start as the prior.

    With S = L E L' over the rows present, ``coupling`` holds L E and ``factor`` holds L below the
    diagonal, by columns; both give back S without a second product with P. They are empty if S is
    there already (``variance``): then innovations are corrected through the mean. ``at`` are the
    rows of y that have to be there, empty if these rows are no rows of y.
    """

    builder: PhaseBuilder
    rows: list[Row]
    at: tuple[int, ...]
    tag: str
    form: Form
    variance: ca.SX | None
    rank_tolerance: float | None
    prior: ca.SX
    covariance: ca.SX
    gain: ca.SX | None
    pivots_per_log: InitVar[int]
    gate: Gate | None = None
    mean: ca.SX = field(init=False)
    determinant: list[ca.SX] = field(init=False)
    nis: ca.SX = field(default_factory=lambda: ca.SX(0))
    log_constant: ca.SX = field(default_factory=lambda: ca.SX(0))
    coupling: list[ca.SX] = field(default_factory=list)
    factor: list[ca.SX] = field(default_factory=list)
    pivot: list[ca.SX] = field(default_factory=list)
    weight: list[ca.SX] = field(default_factory=list)
    symbols: dict[str, ca.SX] = field(default_factory=dict)
    rejected: list[ca.SX] = field(default_factory=list)

    def __post_init__(self, pivots_per_log: int) -> None:
        self.mean = self.prior
        self.determinant = [ca.SX(1)] * -(-len(self.rows) // pivots_per_log)
        start = {f"mean{self.tag}": self.mean, f"covariance{self.tag}": self.covariance}
        self.symbols = {name: self.builder.local(name, v.numel()) for name, v in start.items()}
        self.builder.assign(start)

    def update_row(self, i: int) -> None:
        """Take row i in: Anderson & Moore 1979, sec. 6.5 (sequential processing)."""
        row, builder, tag, significant = self.rows[i], self.builder, self.tag, None
        cross = unpack(self.covariance, self.mean.numel()) @ row.c
        if row.shared is not None:
            cross = cross + row.shared
        if not all(each.is_leaf() for each in ca.vertsplit(cross)):
            cross = builder.define(f"cross{tag}_{i}", cross)
        later = self.rows[i + 1 :] if self.variance is None else []
        products = [ca.mtimes(other.c.T, cross) for other in later]
        coupling = builder.define(f"coupling{tag}_{i}", column(products))
        pivot = builder.define(f"pivot{tag}_{i}", ca.mtimes(row.c.T, cross) + row.variance)
        self.coupling.append(coupling)
        self.pivot.append(pivot)
        innovation = self._innovation(i)
        if is_zero(pivot):  # a row that is always zero, without noise
            self.weight.append(ca.SX(0))
            self.factor.append(ca.SX.zeros(coupling.numel()))
            self.rejected += [ca.SX(0)] if self.gate else []
            return
        if self.rank_tolerance is not None and self.variance is not None:
            own = diagonal(self.variance)[i]
            builder.demand(Kind.NONNEGATIVE, [own], Status.NOT_POSITIVE_DEFINITE)
            significant = pivot - self.rank_tolerance * own  # no combination of the rows before it
        row_of_y = self.at[i] if self.at else None
        if self.gate is not None:
            tested = builder.define(f"given_before{tag}_{i}", innovation), pivot
            name = f"rejected{tag}_{i}"
            flag, significant = self.gate.row(builder, name, self.at[i], tested, significant)
            self.rejected.append(flag)
        with builder.if_present(row_of_y, significant, present=bool(self.at)):
            self._update(i, cross, innovation)

    def _innovation(self, i: int) -> ca.SX:
        """Innovation of row i given the rows before it."""
        row = self.rows[i]
        if self.variance is not None:
            return row.innovation - (ca.mtimes(row.c.T, self.mean - self.prior) if i else 0)
        innovation = row.innovation
        for j in range(i):
            innovation = innovation - self.coupling[j][i - j - 1] * self.weight[j]
        return innovation

    def _update(self, i: int, cross: ca.SX, innovation: ca.SX) -> None:
        builder, row, tag, pivot = self.builder, self.rows[i], self.tag, self.pivot[i]
        builder.demand(Kind.POSITIVE, [pivot], Status.NOT_POSITIVE_DEFINITE)
        inverse = builder.define(f"inverse{tag}_{i}", 1 / pivot, initial=0.0)
        weight, k = innovation * inverse, cross * inverse
        constant = pivot.is_constant()  # its logarithm is taken right here
        chunk = i * len(self.determinant) // len(self.rows)
        new = {
            f"weight{tag}_{i}": weight,
            f"factor{tag}_{i}": self.coupling[i] * inverse,
            f"quadratic{tag}": self.nis + innovation * weight,
            f"log_constant{tag}": self.log_constant
            + (LOG_TWO_PI + math.log(float(pivot)) if constant else LOG_TWO_PI),
        }
        if not constant:
            new[f"determinant{tag}_{chunk}"] = self.determinant[chunk] * pivot
        if cross.nnz():  # else a row of noise alone, which says nothing about the state
            new[f"mean{tag}"] = self.mean + cross * weight
            new[f"covariance{tag}"] = self._reduced(row, cross, k)
        if self.gain is not None:
            gain = self.gain + ca.mtimes(k, row.of_y.T - ca.mtimes(row.c.T, self.gain))
            new[f"update_gain{tag}"] = ca.reshape(ca.densify(gain), -1, 1)
        symbol = {name: self._symbol(name, value.numel()) for name, value in new.items()}
        builder.assign({name: value for name, value in new.items() if value.numel()})
        self.weight.append(symbol[f"weight{tag}_{i}"])
        self.factor.append(symbol[f"factor{tag}_{i}"])
        self.nis = symbol[f"quadratic{tag}"]
        self.log_constant = symbol[f"log_constant{tag}"]
        self.determinant[chunk] = symbol.get(f"determinant{tag}_{chunk}", self.determinant[chunk])
        self.mean = symbol.get(f"mean{tag}", self.mean)
        self.covariance = symbol.get(f"covariance{tag}", self.covariance)
        if self.gain is not None:
            known = ca.reshape(symbol[f"update_gain{tag}"], *gain.shape)
            self.gain = ca.project(known, gain.sparsity())

    def _symbol(self, name: str, size: int) -> ca.SX:
        """The variable of this name, declared at first use: neutral where its row is missing."""
        if name not in self.symbols:
            initial = 1.0 if name.startswith("determinant") else 0.0
            self.symbols[name] = self.builder.local(name, size, initial) if size else ca.SX(0, 1)
        return self.symbols[name]

    def innovation_covariance(self) -> ca.SX:
        """S = L E L' of all rows, packed, from the products at hand."""
        entries = []
        for i, j in triangle(len(self.rows)):
            first = self.pivot[i] if i == j else self.coupling[j][i - j - 1]
            lower = (self.coupling[k][i - k - 1] * self.factor[k][j - k - 1] for k in range(j))
            entries.append(total([first, *lower]))
        return column(entries)

    def _reduced(self, row: Row, cross: ca.SX, k: ca.SX) -> ca.SX:
        """P - k (P c)', in Joseph form corrected by the residual r k - (P - k c'P) c."""
        short = self.covariance - outer_lower(k, cross)
        if self.form == "short":
            return short
        residual = row.variance * k - unpack(short, cross.numel()) @ row.c
        if row.shared is not None:
            residual = residual - row.shared
        reduced = short + outer_lower(residual, k)
        if self.rank_tolerance is None:
            return reduced
        entries = zip(ca.vertsplit(reduced), triangle(cross.numel()), strict=True)
        return column([ca.fmax(v, 0) if a == b else v for v, (a, b) in entries])
