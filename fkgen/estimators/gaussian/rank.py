"""d' D^+ d and the rank of D for a positive semidefinite D, by elimination with diagonal pivoting.

D = P - P* is a difference of covariances: its entries carry rounding of the size of P. A direction
therefore counts while its pivot exceeds `DIRECTION` of the variance of P there; that decision does
not change with the units of the state. Where D is carried in factors, the elimination is that of
Gram and Schmidt on rows of U, and nothing is lost to P. For d in the range of D every generalised
inverse gives the same d' D^- d, so no eigenvalue is needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.interface import triangle
from fkgen.symbolic.linalg import column, pack, unpack

#: Share of a variance that a measurement has to remove to count as information.
DIRECTION = {"double": 1e-11, "float": 1e-4}


@dataclass(frozen=True, slots=True)
class QuadraticForm:
    """Locals of one quadratic form: its value, its rank, and what is looked up by the rank."""

    value: ca.SX
    rank: ca.SX
    looked_up: ca.SX


def quadratic_form(
    builder: PhaseBuilder,
    names: tuple[str, str, str],
    n: int,
    tolerance: float,
    table: list[float],
    *,
    weights: ca.SX | None = None,
) -> QuadraticForm:
    """Write the elimination of D, of d and of the variances that pivots are measured by.

    D is packed, or as n rows one after the other if there are ``weights`` of their columns.

    All three are locals that it uses up, by their ``names``. ``tolerance`` is the smallest share of
    a variance that counts; ``table[r - 1]`` is looked up at rank r.
    """
    tag = names[0].removeprefix("difference")
    packed, vector, variance = (builder.symbol(name) for name in names)
    held = _Entries(packed, n) if weights is None else _RowsOfFactors(packed, weights, n)
    form = QuadraticForm(
        *(builder.local(f"{what}{tag}", 1, 0.0) for what in ("statistic", "dof", "threshold"))
    )
    for j in range(n):
        for i in range(j + 1, n):  # components change places if i has the larger share
            order = list(range(n))
            order[j], order[i] = i, j
            with builder.if_positive(held.at(i, i) * variance[j] - held.at(j, j) * variance[i]):
                new = held.exchanged(order, j), vector[order], variance[order]
                builder.assign(dict(zip(names, new, strict=True)))
        pivot = held.at(j, j)
        with builder.if_positive(pivot - tolerance * variance[j]):
            inverse = builder.define(f"inverse{tag}_{j}", 1 / pivot, initial=0.0)
            weight = vector[j] * inverse
            rest, shares = ca.SX(vector), dict[int, ca.SX]()
            for i in range(j + 1, n):
                shares[i] = builder.define(f"share{tag}_{j}_{i}", held.at(i, j) * inverse, 0.0)
                rest[i] = vector[i] - shares[i] * vector[j]
            left = {names[0]: held.reduced(j, shares), names[1]: rest} if j + 1 < n else {}
            builder.assign(
                {
                    f"statistic{tag}": form.value + vector[j] * weight,
                    f"dof{tag}": ca.SX(j + 1),
                    f"threshold{tag}": ca.SX(table[j]),
                    **left,
                }
            )
    return form


class _Entries:
    """D by its entries, packed."""

    def __init__(self, packed: ca.SX, n: int) -> None:
        self.matrix, self.n = ca.densify(unpack(packed, n)), n

    def at(self, i: int, j: int) -> ca.SX:
        """Entry (i, j)."""
        return self.matrix[i, j]

    def exchanged(self, order: list[int], first: int) -> ca.SX:
        """In another order of the components from ``first`` on."""
        M = self.matrix
        pairs = triangle(self.n)
        return column([M[order[a], order[b]] if b >= first else M[a, b] for a, b in pairs])

    def reduced(self, j: int, shares: dict[int, ca.SX]) -> ca.SX:
        """Without component j, of which the others have these shares."""
        reduced = ca.SX(self.matrix)
        for i, share in shares.items():
            for k in range(j + 1, i + 1):
                reduced[i, k] = self.matrix[i, k] - share * self.matrix[k, j]
        return pack(reduced)


class _RowsOfFactors:
    """D = B W B' by the n rows of B, one after the other."""

    def __init__(self, rows: ca.SX, weights: ca.SX, n: int) -> None:
        self.rows, self.weights = ca.vertsplit(rows, n), weights

    def at(self, i: int, j: int) -> ca.SX:
        """Entry (i, j)."""
        return ca.mtimes((self.rows[i] * self.weights).T, self.rows[j])

    def exchanged(self, order: list[int], first: int) -> ca.SX:  # noqa: ARG002
        """In another order of the components."""
        return ca.vertcat(*(self.rows[i] for i in order))

    def reduced(self, j: int, shares: dict[int, ca.SX]) -> ca.SX:
        """Without component j, of which the others have these shares."""
        rows = list(self.rows)
        for i, share in shares.items():
            rows[i] = self.rows[i] - share * self.rows[j]
        return ca.vertcat(*rows)


def thresholds(false_alarm: float, n: int) -> list[float]:
    """What a chi-square variable of 1, 2, ..., n degrees of freedom exceeds so often."""
    from scipy.special import chdtri  # noqa: PLC0415 - slow to import

    return [float(chdtri(dof, false_alarm)) for dof in range(1, n + 1)]
