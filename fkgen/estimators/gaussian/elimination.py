"""LDL' elimination of an innovation covariance over the rows present, for likelihoods."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from fkgen.estimators.gaussian.sequential import LOG_TWO_PI
from fkgen.symbolic.builder import Script
from fkgen.symbolic.interface import Kind, Status
from fkgen.symbolic.linalg import unpack


@dataclass(frozen=True, slots=True)
class Whitened:
    """Columns e of vectors over y, transformed so that e' S^-1 f = sum of e_j f_j inverse_j.

    ``inverse`` is zero for missing rows, which leaves them out of every sum.
    """

    columns: ca.SX
    inverse: list[ca.SX]
    log_determinant: ca.SX

    def quadratic(self, combination: ca.SX) -> ca.SX:
        """E' S^-1 e for e = columns @ combination."""
        e = self.columns @ combination
        total = ca.SX(0)
        for j, inverse in enumerate(self.inverse):
            total += e[j] * e[j] * inverse
        return total


def whiten(script: Script, packed: ca.SX, columns: ca.SX, tag: str) -> Whitened:
    """Write the blocks that eliminate S (packed) from ``columns`` (p, c)."""
    p = columns.shape[0]
    S = ca.SX(unpack(packed, p))
    rows = [columns[i, :] for i in range(p)]
    inverses, logs = [], ca.SX(0)
    for j in range(p):
        pivot = script.let(f"whitening_pivot{tag}_{j}", S[j, j])
        inverse = script.local(f"whitening_inverse{tag}_{j}", 1, initial=0.0)
        log = script.local(f"whitening_log{tag}_{j}", 1, initial=0.0)
        with script.when(j):
            script.demand(Kind.POSITIVE, [pivot], Status.NOT_POSITIVE_DEFINITE)
            script.put({f"whitening_inverse{tag}_{j}": 1 / pivot})
            script.put({f"whitening_log{tag}_{j}": ca.log(pivot) + LOG_TWO_PI})
        inverses.append(inverse)
        logs += log
        for i in range(j + 1, p):
            share = script.let(f"whitening{tag}_{j}_{i}", S[i, j] * inverse)
            rows[i] = rows[i] - share * rows[j]
            for k in range(j + 1, i + 1):
                S[i, k] = S[i, k] - share * S[k, j]
    return Whitened(ca.vertcat(*rows), inverses, logs)
