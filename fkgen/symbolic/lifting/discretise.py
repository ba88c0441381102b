"""Discretisation at run time: series over T / 2^s, then s doublings, in which nothing cancels.

G = int exp(A s) ds and the covariance are series of fixed length while the norm of A T / 2^s is at
most `SMALL`; then G(2h) = G + F G, Q(2h) = Q + F Q F' with F = exp(A h) = 1 + A G.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import product

import casadi as ca
import numpy as np

from fkgen.problem import Spec
from fkgen.problem.text.discretise import Continuous
from fkgen.symbolic.linalg import pack, row_congruence, sparse, unpack

#: Norm of A h up to which terms of this number leave less than 1e-16: h^k / (k + 1)! of G, and
#: (2 h)^k / (k + 1)! of the covariance.
SMALL, TERMS = 0.5, 17

#: A parameter without a range may make the norm so many times larger than its default does.
ROOM = 8.0

#: At most so many parameters with a range are tried in all corners.
CORNERS = 6


def doublings(spec: Spec, source: Continuous) -> int:
    """How often T / 2^s is doubled, so that the series do for every parameter in its range."""
    involved = [item for item in spec.parameters if item.name in source.names]
    ranges = [(p.low, p.high) for p in involved]
    bounded = all(map(math.isfinite, np.ravel(ranges))) and len(involved) <= CORNERS
    corners = product(*ranges) if bounded else [tuple(p.default for p in involved)]
    largest = 0.0
    for corner in corners:
        values = dict(zip((p.name for p in involved), corner, strict=True))
        largest = max(largest, source.norm(spec.defaults | values))
    return max(0, math.ceil(math.log2(max(1.0, largest * (1.0 if bounded else ROOM) / SMALL))))


def discretised(
    source: Continuous, matrices: Mapping[str, ca.SX], T: ca.SX, count: int
) -> tuple[dict[str, ca.SX], list[ca.SX]]:
    """A, B, c and Q from sample to sample; what must not be negative for the series to do."""
    A, n = matrices["A"], len(source.A.rows)
    h, one = T / 2.0**count, ca.SX.eye(n)
    held = one
    for k in range(TERMS, 1, -1):
        held = one + sparse(A @ held) * (h / k)
    held = held * h
    term = noise = matrices["Q"] * h
    for k in range(2, TERMS + 2):
        grown = sparse(A @ term)
        term = (grown + grown.T) * (h / k)
        noise = noise + term
    packed = pack(noise)
    for _ in range(count):
        moved = one + sparse(A @ held)
        held, packed = held + moved @ held, packed + row_congruence(moved, unpack(packed, n))
    found = {"A": one + sparse(A @ held), "B": held @ matrices["B"], "c": held @ matrices["c"]}
    limit = SMALL * 2.0**count
    rows = [limit - ca.sum2(ca.fabs(A[i, :])) * ca.fabs(T) for i in range(n) if A[i, :].nnz()]
    return found | {"Q": unpack(packed, n)}, rows
