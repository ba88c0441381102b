"""d' D^+ d and the rank of D for a positive semidefinite D, by elimination with diagonal pivoting.

D = P - P* is a difference of covariances: its entries carry rounding of the size of P. A direction
therefore counts while its pivot exceeds `DIRECTION` of the variance of P there; that decision does
not change with the units of the state. For d in the range of D every generalised inverse gives the
same d' D^- d, so no eigenvalue is needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from fkgen.symbolic.builder import Script
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
    script: Script, names: tuple[str, str, str], n: int, tolerance: float, table: list[float]
) -> QuadraticForm:
    """Write the elimination of D (packed), of d and of the variances that pivots are measured by.

    All three are locals that it uses up, by their ``names``. ``tolerance`` is the smallest share of
    a variance that counts; ``table[r - 1]`` is looked up at rank r.
    """
    tag = names[0].removeprefix("difference")
    packed, vector, variance = (script.symbol(name) for name in names)
    matrix = ca.densify(unpack(packed, n))
    form = QuadraticForm(
        *(script.local(f"{what}{tag}", 1, 0.0) for what in ("statistic", "dof", "threshold"))
    )
    for j in range(n):
        for i in range(j + 1, n):  # components change places if i has the larger share
            order = list(range(n))
            order[j], order[i] = i, j
            exchanged = column(
                [matrix[order[a], order[b]] if b >= j else matrix[a, b] for a, b in triangle(n)]
            )
            with script.where(matrix[i, i] * variance[j] - matrix[j, j] * variance[i]):
                new = exchanged, vector[order], variance[order]
                script.put(dict(zip(names, new, strict=True)))
        pivot = matrix[j, j]
        with script.where(pivot - tolerance * variance[j]):
            inverse = script.let(f"inverse{tag}_{j}", 1 / pivot, initial=0.0)
            weight = vector[j] * inverse
            reduced, rest = ca.SX(matrix), ca.SX(vector)
            for i in range(j + 1, n):
                share = script.let(f"share{tag}_{j}_{i}", matrix[i, j] * inverse, 0.0)
                rest[i] = vector[i] - share * vector[j]
                for k in range(j + 1, i + 1):
                    reduced[i, k] = matrix[i, k] - share * matrix[k, j]
            left = {names[0]: pack(reduced), names[1]: rest} if j + 1 < n else {}
            script.put(
                {
                    f"statistic{tag}": form.value + vector[j] * weight,
                    f"dof{tag}": ca.SX(j + 1),
                    f"threshold{tag}": ca.SX(table[j]),
                    **left,
                }
            )
    return form


def thresholds(false_alarm: float, n: int) -> list[float]:
    """What a chi-square variable of 1, 2, ..., n degrees of freedom exceeds so often."""
    from scipy.special import chdtri  # noqa: PLC0415 - slow to import

    return [float(chdtri(dof, false_alarm)) for dof in range(1, n + 1)]
