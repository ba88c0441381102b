"""The update by one row of y where P is carried as U D U': Bierman 1977, sec. V.3."""

from __future__ import annotations

from dataclasses import dataclass, field

import casadi as ca

from fkgen.estimators.gaussian.decorrelation import Row
from fkgen.estimators.gaussian.rows import SequentialUpdate
from fkgen.estimators.gaussian.ud import Factors, is_positive, reciprocal
from fkgen.symbolic.linalg import is_zero, sparse


@dataclass(frozen=True, slots=True)
class _Sums:
    """What one row makes of U and D: f = U' c, and sums over the columns up to each.

    With v = D f, ``variance[j]`` is r + f_0 v_0 + ... + f_j v_j, and ``cross[i, j]`` entry i of
    U_0 v_0 + ... + U_j v_j. The last ones are the pivot and P c.
    """

    sensed: ca.SX  # (n, 1), f
    variance: ca.SX  # (n, 1)
    cross: ca.SX  # (n, n)


@dataclass(slots=True, kw_only=True)
class FactoredUpdate(SequentialUpdate):
    """A sequential update whose ``covariance`` is packed factors, of this order."""

    order: tuple[int, ...]
    scalar: str
    sums: _Sums = field(init=False)

    @property
    def factors(self) -> Factors:
        """U and D so far."""
        return Factors.of(self.covariance, self.order, self.scalar)

    def sensed(self, row: Row, label: str) -> tuple[ca.SX, ca.SX]:
        """P c and c' P c + r: sums of terms that are not negative."""
        held, n, r = self.factors, len(self.order), ca.SX(row.variance)
        f = held.unit.T @ row.c[list(self.order)]
        variance, cross = ca.SX(n, 1), ca.SX(n, n)
        for j in range(n):
            before = variance[j - 1] if j else r
            weighted = held.scale[j] * f[j]
            if is_zero(f[j]):
                variance[j] = before
                if j:
                    cross[:, j] = cross[:, j - 1]
                continue
            variance[j] = before + f[j] * weighted
            own = sparse(held.unit[:, j] * weighted)
            cross[:, j] = own + cross[:, j - 1] if j else own
        given = ca.vertcat(r, f, variance, ca.vec(cross))
        named = self.builder.name_distinct(f"sums{label}", (ca.SX(given),))[0]
        variance, cross = named[1 + n : 1 + 2 * n], ca.reshape(named[1 + 2 * n :], n, n)
        self.sums = _Sums(named[1 : 1 + n], ca.vertcat(named[0], variance), ca.SX(cross))
        place = {state: at for at, state in enumerate(self.order)}
        whole = ca.vertcat(*(cross[place[state], n - 1] for state in range(n)))
        return whole, self.sums.variance[n]

    def reduced(self, row: Row, cross: ca.SX, k: ca.SX) -> ca.SX:  # noqa: ARG002
        """The factors of P - P c (P c)' / pivot, packed."""
        held, sums, n = self.factors, self.sums, len(self.order)
        unit, scale = ca.SX(held.unit), ca.SX(held.scale)
        noisy = is_positive(ca.SX(row.variance), self.scalar)
        inverse, _ = reciprocal(sums.variance[0], self.scalar, positive=noisy)
        for j in range(n):
            if is_zero(sums.sensed[j]):
                continue
            share = sums.sensed[j] * inverse
            inverse, nothing = reciprocal(sums.variance[j + 1], self.scalar, positive=noisy)
            scale[j] = held.scale[j] * (sums.variance[j] * inverse + nothing)
            for i in range(j):
                if not is_zero(sums.cross[i, j - 1]):
                    unit[i, j] = held.unit[i, j] - share * sums.cross[i, j - 1]
        return Factors(unit, scale, self.order, self.scalar).packed
