"""Condition a Gaussian prior on the rows of y that are present, one scalar update per row.

No matrix is inverted: a row costs one reciprocal. Correlated measurement noise is first
decorrelated by LDL' elimination over the rows that are present, so that a missing row leaves R as
well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import casadi as ca

from fkgen.symbolic.decorrelation import Measurement, Row, decorrelate
from fkgen.symbolic.interface import Kind, Status
from fkgen.symbolic.linalg import column, congruence, is_zero, operations, outer_lower, pack, unpack
from fkgen.symbolic.packing import triangle
from fkgen.symbolic.script import Script

Form = Literal["short", "joseph"]

#: A row is redundant when its pivot is below this share of its prior variance (rank decision).
RANK_TOLERANCE = {"double": 2e-13, "float": 1e-4}

#: Pivots that are multiplied before the logarithm: in double each may span 1e-75 to 1e75.
PIVOTS_PER_LOG = {"double": 4, "float": 1}

LOG_TWO_PI = math.log(2.0 * math.pi)


@dataclass(frozen=True, slots=True, kw_only=True)
class Conditioned:
    """What one measurement says.

    Attributes
    ----------
    mean : (m,) SX
    covariance : (m (m + 1) / 2,) SX
        Packed.
    innovation : (p,) SX
        Zero where the row is missing.
    innovation_covariance : (p (p + 1) / 2,) SX
        Packed, of all rows, present or not.
    nis, log_likelihood : SX
        Over the rows present.
    gain : (m, p) SX or None
        d mean / d y, columns of missing rows zero.
    """

    mean: ca.SX
    covariance: ca.SX
    innovation: ca.SX
    innovation_covariance: ca.SX
    nis: ca.SX
    log_likelihood: ca.SX
    gain: ca.SX | None


def condition(
    script: Script,
    prior: tuple[ca.SX, ca.SX],
    measurement: Measurement,
    *,
    tag: str = "",
    form: Form,
    with_gain: bool = False,
) -> Conditioned:
    """Write the blocks that condition ``prior``, mean and covariance, on ``measurement``."""
    mean, covariance = prior
    p, m = measurement.C.shape
    innovation = _innovations(script, mean, measurement, tag)
    variance = _variance(script, covariance, measurement, tag)
    rows = decorrelate(script, measurement, innovation, tag)
    packed = pack(covariance)
    symbols = {
        f"mean{tag}": script.local(f"mean{tag}", m),
        f"covariance{tag}": script.local(f"covariance{tag}", packed.numel()),
    }
    script.put({f"mean{tag}": mean, f"covariance{tag}": packed})
    fold = _Fold(
        script=script,
        rows=rows,
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
        with script.titled(f"row {i} of y, {measurement.rows[i]}"):
            fold.take(i)
    return Conditioned(
        mean=fold.mean,
        covariance=fold.covariance,
        innovation=column(innovation),
        innovation_covariance=fold.innovation_covariance() if variance is None else variance,
        nis=fold.nis,
        log_likelihood=-0.5 * (fold.nis + fold.log_determinant()),
        gain=fold.gain,
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


def _innovations(script: Script, mean: ca.SX, measurement: Measurement, tag: str) -> list[ca.SX]:
    result = []
    with script.titled("innovation, row by row"):
        for i in range(measurement.C.shape[0]):
            name = f"innovation{tag}_{i}"
            symbol = script.local(name, 1, initial=0.0)
            predicted = ca.mtimes(measurement.C[i, :], mean)
            with script.when(i):
                script.put({name: measurement.y[i] - predicted - measurement.offset[i]})
            result.append(symbol)
    return result


@dataclass(slots=True, kw_only=True)
class _Fold:
    """Builder of the sequential update: the values so far, which start as the prior.

    With S = L E L' over the rows present, ``coupling`` holds L E and ``factor`` holds L below the
    diagonal, by columns; both give back S without a second product with P. They are empty if S is
    there already (``variance``): then innovations are corrected through the mean.
    """

    script: Script
    rows: list[Row]
    tag: str
    form: Form
    variance: ca.SX | None
    rank_tolerance: float | None
    prior: ca.SX
    mean: ca.SX
    covariance: ca.SX
    gain: ca.SX | None
    determinant: list[ca.SX]
    nis: ca.SX = field(default_factory=lambda: ca.SX(0))
    log_two_pi: ca.SX = field(default_factory=lambda: ca.SX(0))
    coupling: list[ca.SX] = field(default_factory=list)
    factor: list[ca.SX] = field(default_factory=list)
    pivot: list[ca.SX] = field(default_factory=list)
    weight: list[ca.SX] = field(default_factory=list)
    symbols: dict[str, ca.SX] = field(default_factory=dict)

    def take(self, i: int) -> None:
        """Fold in row i: Anderson & Moore 1979, sec. 6.5 (sequential processing)."""
        row, script = self.rows[i], self.script
        cross = unpack(self.covariance, self.mean.numel()) @ row.c
        if not all(cross[k].is_leaf() for k in range(cross.numel())):
            cross = script.let(f"cross{self.tag}_{i}", cross)
        later = self.rows[i + 1 :] if self.variance is None else []
        products = [ca.mtimes(other.c.T, cross) for other in later]
        coupling = ca.SX(0, 1)
        if products:
            coupling = script.let(f"coupling{self.tag}_{i}", column(products))
        pivot = script.let(f"pivot{self.tag}_{i}", ca.mtimes(row.c.T, cross) + row.variance)
        innovation = self._innovation(i)
        if is_zero(pivot):  # a row that is always zero, without noise
            self.weight.append(ca.SX(0))
            self.factor.append(ca.SX.zeros(coupling.numel()))
        else:
            with script.when(i, self._significant(i, pivot)):
                self._update(i, (cross, coupling, pivot, innovation))
        self.coupling.append(coupling)
        self.pivot.append(pivot)

    def _innovation(self, i: int) -> ca.SX:
        """Innovation of row i given the rows before it."""
        row = self.rows[i]
        if self.variance is not None:
            return row.innovation - (ca.mtimes(row.c.T, self.mean - self.prior) if i else 0)
        innovation = row.innovation
        for j in range(i):
            innovation = innovation - self.coupling[j][i - j - 1] * self.weight[j]
        return innovation

    def _significant(self, i: int, pivot: ca.SX) -> ca.SX | None:
        """Positive when row i is no combination of the rows before it; None if that cannot be."""
        if self.rank_tolerance is None or self.variance is None:
            return None
        own = self.variance[i * (i + 3) // 2]
        self.script.demand(Kind.NONNEGATIVE, [own], Status.NOT_POSITIVE_DEFINITE)
        return pivot - self.rank_tolerance * own

    def _update(self, i: int, values: tuple[ca.SX, ca.SX, ca.SX, ca.SX]) -> None:
        cross, coupling, pivot, innovation = values
        script, row, tag = self.script, self.rows[i], self.tag
        chunk = i * len(self.determinant) // len(self.rows)
        script.demand(Kind.POSITIVE, [pivot], Status.NOT_POSITIVE_DEFINITE)
        inverse = script.let(f"inverse{tag}_{i}", 1 / pivot, initial=0.0)
        weight = innovation * inverse
        k = cross * inverse
        new = {
            f"weight{tag}_{i}": weight,
            f"factor{tag}_{i}": coupling * inverse,
            f"quadratic{tag}": self.nis + innovation * weight,
            f"determinant{tag}_{chunk}": self.determinant[chunk] * pivot,
            f"log_two_pi{tag}": self.log_two_pi + LOG_TWO_PI,
            f"mean{tag}": self.mean + cross * weight,
            f"covariance{tag}": self._reduced(row, cross, k),
        }
        if self.gain is not None:
            gain = self.gain + ca.mtimes(k, row.of_y.T - ca.mtimes(row.c.T, self.gain))
            new[f"update_gain{tag}"] = ca.reshape(ca.densify(gain), -1, 1)
        symbol = {name: self._symbol(name, value.numel()) for name, value in new.items()}
        script.put({name: value for name, value in new.items() if value.numel()})
        self.weight.append(symbol[f"weight{tag}_{i}"])
        self.factor.append(symbol[f"factor{tag}_{i}"])
        self.nis = symbol[f"quadratic{tag}"]
        self.determinant[chunk] = symbol[f"determinant{tag}_{chunk}"]
        self.log_two_pi = symbol[f"log_two_pi{tag}"]
        self.mean, self.covariance = symbol[f"mean{tag}"], symbol[f"covariance{tag}"]
        if self.gain is not None:
            known = ca.reshape(symbol[f"update_gain{tag}"], *gain.shape)
            self.gain = ca.project(known, gain.sparsity())

    def _symbol(self, name: str, size: int) -> ca.SX:
        """The variable of this name, declared at first use: neutral where its row is missing."""
        if name not in self.symbols:
            initial = 1.0 if name.startswith("determinant") else 0.0
            self.symbols[name] = self.script.local(name, size, initial) if size else ca.SX(0, 1)
        return self.symbols[name]

    def log_determinant(self) -> ca.SX:
        """Logarithm of det(2 pi S) over the rows present, one call for several pivots."""
        total = self.log_two_pi
        for product in self.determinant:
            total = total + ca.log(product)
        return total

    def innovation_covariance(self) -> ca.SX:
        """S = L E L' of all rows, packed, from the products at hand."""
        entries = []
        for i, j in triangle(len(self.rows)):
            value = self.pivot[i] if i == j else self.coupling[j][i - j - 1]
            for k in range(j):
                value = value + self.coupling[k][i - k - 1] * self.factor[k][j - k - 1]
            entries.append(value)
        return column(entries)

    def _reduced(self, row: Row, cross: ca.SX, k: ca.SX) -> ca.SX:
        """P - k (P c)', in Joseph form corrected by the residual r k - (P - k c'P) c."""
        short = self.covariance - outer_lower(k, cross)
        if self.form == "short":
            return short
        m = cross.numel()
        residual = row.variance * k - unpack(short, m) @ row.c
        reduced = short + outer_lower(residual, k)
        if self.rank_tolerance is not None:
            diagonal = {position for position, (a, b) in enumerate(triangle(m)) if a == b}
            entries = [reduced[at] for at in range(reduced.numel())]
            reduced = column(
                [ca.fmax(v, 0) if at in diagonal else v for at, v in enumerate(entries)]
            )
        return reduced
