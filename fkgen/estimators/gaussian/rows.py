"""One update of mean and covariance by one row of y, and what rows have told so far."""

from __future__ import annotations

import math
from dataclasses import InitVar, dataclass, field
from typing import Literal

import casadi as ca

from fkgen.estimators.gaussian.decorrelation import LOG_TWO_PI, Row
from fkgen.estimators.gaussian.gate import Gate
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.index import Whole
from fkgen.symbolic.interface import Kind, Status, triangle
from fkgen.symbolic.linalg import cleared, column, diagonal, is_zero, outer_lower, total, unpack

Form = Literal["short", "joseph", "ud"]


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
    at: tuple[Whole, ...]
    tag: str
    form: Form
    variance: ca.SX | None
    rank_tolerance: float | None
    prior: ca.SX
    covariance: ca.SX
    gain: ca.SX | None
    pivots_per_log: InitVar[int]
    gate: Gate | None = None
    kept: tuple[ca.SX | None, ...] = ()  # kept, apart: as of a measurement
    apart: tuple[int, ...] = ()
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

    def label(self, i: int) -> str:
        """What names of row i end with."""
        return f"{self.tag}_{i}"

    def update_row(self, i: int) -> None:
        """Take row i in: Anderson & Moore 1979, sec. 6.5 (sequential processing)."""
        row, builder, label, significant = self.rows[i], self.builder, self.label(i), None
        cross, variance = self.sensed(row, label)
        later = self.rows[i + 1 :] if self.variance is None else []
        products = [ca.mtimes(other.c.T, cross) for other in later]
        coupling = self.named(f"coupling{label}", column(products))
        pivot = builder.define(f"pivot{label}", variance)
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
        counts = self.kept[i] if self.kept else None
        if counts is not None:
            significant = counts if significant is None else ca.fmin(counts, significant)
        row_of_y = self.at[i] if self.at else None
        if self.gate is not None:
            tested = builder.define(f"given_before{label}", innovation), pivot
            name = f"rejected{label}"
            flag, significant = self.gate.row(builder, name, self.at[i], tested, significant)
            self.rejected.append(flag)
        with builder.if_present(row_of_y, significant, present=bool(self.at)):
            self.take(i, cross, innovation)

    def named(self, name: str, value: ca.SX) -> ca.SX:
        """A value that is computed once; entries between parts of the state stay 0."""
        return (self.builder.name_entries if self.apart else self.builder.define)(name, value)

    def sensed(self, row: Row, label: str) -> tuple[ca.SX, ca.SX]:
        """P c, and the variance of the innovation of a row."""
        cross = unpack(self.covariance, self.mean.numel()) @ row.c
        if row.shared is not None:
            cross = cross + row.shared
        if not all(each.is_leaf() for each in ca.vertsplit(cross)):
            cross = self.named(f"cross{label}", cross)
        return cross, ca.mtimes(row.c.T, cross) + row.variance

    def _innovation(self, i: int) -> ca.SX:
        """Innovation of row i given the rows before it."""
        row = self.rows[i]
        if self.variance is not None:
            known = 0 if self.mean is self.prior else ca.mtimes(row.c.T, self.mean - self.prior)
            return row.innovation - known
        innovation = row.innovation
        for j in range(i):
            innovation = innovation - self.coupling[j][i - j - 1] * self.weight[j]
        return innovation

    def take(self, i: int, cross: ca.SX, innovation: ca.SX) -> None:
        """Correct mean and covariance where row i is to be used, with their pivot known."""
        builder, row, tag, pivot = self.builder, self.rows[i], self.tag, self.pivot[i]
        label = self.label(i)
        builder.demand(Kind.POSITIVE, [pivot], Status.NOT_POSITIVE_DEFINITE)
        inverse = builder.define(f"inverse{label}", 1 / pivot, initial=0.0)
        weight, k = innovation * inverse, cross * inverse
        constant = pivot.is_constant()  # its logarithm is taken right here
        chunk = i * len(self.determinant) // len(self.rows)
        new = {
            f"weight{label}": weight,
            f"factor{label}": self.coupling[i] * inverse,
            f"quadratic{tag}": self.nis + innovation * weight,
            f"log_constant{tag}": self.log_constant
            + (LOG_TWO_PI + math.log(float(pivot)) if constant else LOG_TWO_PI),
        }
        if not constant:
            new[f"determinant{tag}_{chunk}"] = self.determinant[chunk] * pivot
        if cross.nnz():  # else a row of noise alone, which says nothing about the state
            new[f"mean{tag}"] = self.mean + cross * weight
            known, reduced = self.symbols[f"covariance{tag}"], self.reduced(row, cross, k)
            new[f"covariance{tag}"] = cleared(reduced, self.apart, known)
        if self.gain is not None:
            gain = self.gain + ca.mtimes(k, row.of_y.T - ca.mtimes(row.c.T, self.gain))
            new[f"update_gain{tag}"] = ca.reshape(ca.densify(gain), -1, 1)
        symbol = {name: self._symbol(name, value.numel()) for name, value in new.items()}
        builder.assign({name: value for name, value in new.items() if value.numel()})
        self.weight.append(symbol[f"weight{label}"])
        self.factor.append(symbol[f"factor{label}"])
        self.nis = symbol[f"quadratic{tag}"]
        self.log_constant = symbol[f"log_constant{tag}"]
        self.determinant[chunk] = symbol.get(f"determinant{tag}_{chunk}", self.determinant[chunk])
        self.mean = symbol.get(f"mean{tag}", self.mean)
        after = symbol.get(f"covariance{tag}", self.covariance)
        self.covariance = cleared(after, self.apart)
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

    def reduced(self, row: Row, cross: ca.SX, k: ca.SX) -> ca.SX:
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
