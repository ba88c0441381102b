"""Sequential update: a mean and a covariance, corrected row by row."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Literal

import casadi as ca

from fkgen.errors import InternalError
from fkgen.estimators.gaussian.decorrelation import Row
from fkgen.symbolic.builder import Script
from fkgen.symbolic.interface import Kind, Status
from fkgen.symbolic.linalg import column, diagonal, is_zero, outer_lower, unpack
from fkgen.symbolic.packing import triangle

Form = Literal["short", "joseph"]

LOG_TWO_PI = math.log(2.0 * math.pi)


@dataclass(slots=True, kw_only=True)
class SequentialUpdate:
    """Builder of the sequential update: the values so far, which start as the prior.

    With S = L E L' over the rows present, ``coupling`` holds L E and ``factor`` holds L below the
    diagonal, by columns; both give back S without a second product with P. They are empty if S is
    there already (``variance``): then innovations are corrected through the mean. ``at`` are the
    rows of y that have to be there, empty if these rows are no rows of y.
    """

    script: Script
    rows: list[Row]
    at: tuple[int, ...]
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
    log_constant: ca.SX = field(default_factory=lambda: ca.SX(0))
    coupling: list[ca.SX] = field(default_factory=list)
    factor: list[ca.SX] = field(default_factory=list)
    pivot: list[ca.SX] = field(default_factory=list)
    weight: list[ca.SX] = field(default_factory=list)
    symbols: dict[str, ca.SX] = field(default_factory=dict)

    def update_row(self, i: int) -> None:
        """SequentialUpdate in row i: Anderson & Moore 1979, sec. 6.5 (sequential processing)."""
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
            with self._given(i, self._significant(i, pivot)):
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

    def _given(self, i: int, significant: ca.SX | None) -> AbstractContextManager[None]:
        """Where row i is there and says something."""
        if self.at:
            return self.script.when(self.at[i], significant)
        if significant is None:
            raise InternalError("a row that is always there needs a rank decision")
        return self.script.where(significant)

    def _significant(self, i: int, pivot: ca.SX) -> ca.SX | None:
        """Positive when row i is no combination of the rows before it; None if that cannot be."""
        if self.rank_tolerance is None or self.variance is None:
            return None
        own = diagonal(self.variance, len(self.rows))[i]
        self.script.demand(Kind.NONNEGATIVE, [own], Status.NOT_POSITIVE_DEFINITE)
        return pivot - self.rank_tolerance * own

    def _update(self, i: int, values: tuple[ca.SX, ca.SX, ca.SX, ca.SX]) -> None:
        cross, coupling, pivot, innovation = values
        script, row, tag = self.script, self.rows[i], self.tag
        script.demand(Kind.POSITIVE, [pivot], Status.NOT_POSITIVE_DEFINITE)
        inverse = script.let(f"inverse{tag}_{i}", 1 / pivot, initial=0.0)
        weight = innovation * inverse
        k = cross * inverse
        new = {
            f"weight{tag}_{i}": weight,
            f"factor{tag}_{i}": coupling * inverse,
            f"quadratic{tag}": self.nis + innovation * weight,
            **self._density(i, pivot),
        }
        if cross.nnz():  # else a row of noise alone, which says nothing about the state
            new[f"mean{tag}"] = self.mean + cross * weight
            new[f"covariance{tag}"] = self._reduced(row, cross, k)
        if self.gain is not None:
            gain = self.gain + ca.mtimes(k, row.of_y.T - ca.mtimes(row.c.T, self.gain))
            new[f"update_gain{tag}"] = ca.reshape(ca.densify(gain), -1, 1)
        symbol = {name: self._symbol(name, value.numel()) for name, value in new.items()}
        script.put({name: value for name, value in new.items() if value.numel()})
        self.weight.append(symbol[f"weight{tag}_{i}"])
        self.factor.append(symbol[f"factor{tag}_{i}"])
        self.nis = symbol[f"quadratic{tag}"]
        self.log_constant = symbol[f"log_constant{tag}"]
        chunk = self._chunk(i)
        self.determinant[chunk] = symbol.get(f"determinant{tag}_{chunk}", self.determinant[chunk])
        self.mean = symbol.get(f"mean{tag}", self.mean)
        self.covariance = symbol.get(f"covariance{tag}", self.covariance)
        if self.gain is not None:
            known = ca.reshape(symbol[f"update_gain{tag}"], *gain.shape)
            self.gain = ca.project(known, gain.sparsity())

    def _chunk(self, i: int) -> int:
        """Which product of pivots row i goes into."""
        return i * len(self.determinant) // len(self.rows)

    def _density(self, i: int, pivot: ca.SX) -> dict[str, ca.SX]:
        """What row i adds to log det(2 pi S); the logarithm of a constant is taken right here."""
        if pivot.is_constant():
            constant = LOG_TWO_PI + math.log(float(pivot))
            return {f"log_constant{self.tag}": self.log_constant + constant}
        chunk = self._chunk(i)
        return {
            f"log_constant{self.tag}": self.log_constant + LOG_TWO_PI,
            f"determinant{self.tag}_{chunk}": self.determinant[chunk] * pivot,
        }

    def _symbol(self, name: str, size: int) -> ca.SX:
        """The variable of this name, declared at first use: neutral where its row is missing."""
        if name not in self.symbols:
            initial = 1.0 if name.startswith("determinant") else 0.0
            self.symbols[name] = self.script.local(name, size, initial) if size else ca.SX(0, 1)
        return self.symbols[name]

    def log_determinant(self) -> ca.SX:
        """Logarithm of det(2 pi S) over the rows present, one call for several pivots."""
        total = self.log_constant
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
