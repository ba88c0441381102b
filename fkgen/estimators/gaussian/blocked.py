"""Conditioning on all rows of y together, in products of matrices: for many states.

With V = C P and S = R + V C' = L D L' over the rows present, W = L^-1 V and G = D^-1 W, the
corrected covariance is P - W' G, and the mean moves by G' L^-1 times the innovation. A missing row
is one whose reciprocal pivot is zero: so is its row of G, and it leaves everything as it was.
The Joseph form is (I - K C) P (I - K C)' + K R K' with K' = L'^-1 G.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import casadi as ca

from fkgen.estimators.gaussian.decorrelation import LOG_TWO_PI, Measurement, has_a_rule
from fkgen.estimators.gaussian.gate import Gate
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.dense import (
    Dense,
    as_packed,
    as_row,
    combine,
    filled,
    multiply,
    room,
    transposed,
    unpacked,
)
from fkgen.symbolic.index import Whole
from fkgen.symbolic.interface import Kind, Status
from fkgen.symbolic.linalg import pack
from fkgen.symbolic.plant import SPARSE

#: What stands above the products of a prediction.
_TITLE = "products with A"

#: Rows of y whose elimination is written out.
UNROLLED = 4


def is_sparse(matrix: ca.SX) -> bool:
    """Whether a matrix is multiplied without its zeros."""
    return bool(matrix.numel() > SPARSE * matrix.nnz())


def is_blocked(measurement: Measurement) -> bool:
    """Whether conditioning on these rows is written in products of matrices."""
    apart = measurement.S is not None or measurement.rank_tolerance is not None
    apart = apart or bool(measurement.kept)
    of_y = bool(measurement.at) and measurement.C.nnz() > 0
    return of_y and not apart and measurement.code_form == "loops"


@dataclass(slots=True, kw_only=True)
class BlockedUpdate:
    """Builder of the update with all rows at once: what is known of them so far.

    The variables of one update serve the next one in the same phase, but for its results, which
    bear its tag.
    """

    builder: PhaseBuilder
    measurement: Measurement
    prior: tuple[ca.SX, ca.SX]
    tag: str
    gate: Gate | None
    covariance: Dense = field(init=False)
    sensed: Dense = field(init=False)  # (m, p), C'
    cross: Dense = field(init=False)  # (p, m), C P, then W
    factor: Dense = field(init=False)  # (p, p), L below the diagonal
    inverse: Dense = field(init=False)  # (1, p), reciprocals of pivots
    given_before: Dense = field(init=False)  # (1, p), innovations given the rows before them
    weighted: Dense = field(init=False)  # (p, m), G
    nis: ca.SX = field(init=False)
    log_constant: ca.SX = field(init=False)
    pivots: list[ca.SX] = field(init=False)
    rejected: list[ca.SX] = field(default_factory=list)

    def __post_init__(self) -> None:
        C, tag = self.measurement.C, self.tag
        m = C.shape[1]
        self.sensed = filled(self.builder, f"sensed{tag}", C.T)
        self.covariance = unpacked(self.builder, "prior_covariance", pack(self.prior[1]), m)

    def expected(self) -> ca.SX:
        """C x, (p, 1)."""
        builder, p = self.builder, self.sensed.columns
        mean = as_row(builder, "prior_mean", self.prior[0])
        found = multiply(builder, room(builder, "expected", 1, p), mean, self.sensed)
        return builder.symbol(found.name)[:p]

    def innovation_covariance(self) -> ca.SX:
        """S = C P C' + R of all rows, packed."""
        builder, measurement, (p, m) = self.builder, self.measurement, self.measurement.C.shape
        self.cross = room(builder, "cross_covariance", p, m)
        if is_sparse(measurement.C):
            combine(builder, self.cross, measurement.C, self.covariance)
        else:
            multiply(builder, self.cross, self.sensed.T, self.covariance)
        noise = filled(builder, f"sensor_noise{self.tag}", measurement.R)
        S = room(builder, "innovation_matrix", p, p)
        multiply(builder, S, self.cross, self.sensed, noise, lower=True)
        return as_packed(builder, f"variance{self.tag}", S)

    def eliminate(self, innovation: list[ca.SX]) -> None:
        """S = L D L' over the rows present; innovations and C P lose what rows before them say."""
        builder, tag, (p, m) = self.builder, self.tag, self.measurement.C.shape
        S = room(builder, "innovation_matrix", p, p)
        self.factor = room(builder, "factor", p, p)
        self.inverse, self.given_before = (
            room(builder, name, 1, p) for name in ("inverse_pivots", "given_before")
        )
        pivots = room(builder, f"pivots{tag}", 1, p)
        self.nis = builder.local(f"quadratic{tag}", 1, initial=0.0)
        self.log_constant = builder.local(f"log_constant{tag}", 1, initial=0.0)
        builder.assign({self.given_before.at(0, i): innovation[i] for i in range(p)})
        if p <= UNROLLED or not has_a_rule(self.measurement.at):
            self.rejected = [flag for i in range(p) for flag in self._eliminate(S, pivots, i)]
        else:
            refused = room(builder, f"rejected{tag}", 1, p)
            with builder.loop("r", 0, p) as row:
                for flag in self._eliminate(S, pivots, row):
                    builder.assign({refused.at(0, row): flag})
            flags = [builder.read(refused.at(0, i)) for i in range(p)]
            self.rejected = flags if self.gate else []
        self.pivots = [builder.read(pivots.at(0, i)) for i in range(p)]
        for below in range(1, p):
            own, above = self.cross.row(below), self.cross.top(below)
            multiply(builder, own, self.factor.row(below, below), above, own, less=True)
        self.weighted = room(builder, "weighted", p, m)
        with builder.loop("i", 0, p) as k, builder.loop("j", 0, m) as j:
            value = builder.read(self.cross.at(k, j)) * builder.read(self.inverse.at(0, k))
            builder.assign({self.weighted.at(k, j): value})

    def _eliminate(self, S: Dense, pivots: Dense, row: Whole) -> list[ca.SX]:
        """Take row ``row`` in, and out of the rows below it; 1 if the gate rejects it."""
        builder, label, p = self.builder, f"{self.tag}_{row}", S.rows
        at = self.measurement.at
        of_y = at[row] if isinstance(row, int) else at[0] + (at[1] - at[0]) * row
        flags = []
        pivot = builder.define(f"pivot{label}", builder.read(S.at(row, row)))
        own = builder.define(f"own{label}", builder.read(self.given_before.at(0, row)))
        builder.assign({self.inverse.at(0, row): ca.SX(0), pivots.at(0, row): ca.SX(1)})
        significant = None
        if self.gate is not None:
            name, tested = f"rejected{label}", (own, pivot)
            flag, significant = self.gate.row(builder, name, of_y, tested, None)
            flags.append(flag)
        with builder.if_present(of_y, significant):
            builder.demand(Kind.POSITIVE, [pivot], Status.NOT_POSITIVE_DEFINITE)
            builder.assign({self.inverse.at(0, row): 1 / pivot, pivots.at(0, row): pivot})
            inverse = builder.read(self.inverse.at(0, row))
            builder.assign(
                {
                    f"quadratic{self.tag}": self.nis + own * (own * inverse),
                    f"log_constant{self.tag}": self.log_constant + LOG_TWO_PI,
                }
            )
        inverse = builder.read(self.inverse.at(0, row))
        with builder.loop("i", row + 1, p) as i:
            coupling = builder.read(S.at(i, row))
            builder.assign({self.factor.at(i, row): coupling * inverse})
            share = builder.read(self.factor.at(i, row))
            rest = builder.read(self.given_before.at(0, i)) - share * own
            builder.assign({self.given_before.at(0, i): rest})
            with builder.loop("j", row + 1, i + 1) as j:
                rest = builder.read(S.at(i, j)) - share * builder.read(S.at(j, row))
                builder.assign({S.at(i, j): rest})
        return flags

    def mean(self) -> ca.SX:
        """The corrected mean."""
        builder, m = self.builder, self.prior[0].numel()
        found = room(builder, f"mean{self.tag}", 1, m)
        prior = as_row(builder, "prior_mean", self.prior[0])
        multiply(builder, found, self.given_before, self.weighted, prior)
        return builder.symbol(found.name)[:m]

    def short(self) -> ca.SX:
        """P - W' G, packed."""
        builder, m = self.builder, self.prior[0].numel()
        left = room(builder, "corrected", m, m)
        multiply(builder, left, self.weighted.T, self.cross, self.covariance, less=True, lower=True)
        return as_packed(builder, f"covariance{self.tag}", left)

    def gain(self) -> Dense:
        """K', (p, m), whose rows are zero where rows of y are missing."""
        builder, (p, m) = self.builder, self.measurement.C.shape
        K = room(builder, f"gain{self.tag}", p, m)
        last = p - 1
        with builder.loop("j", 0, m) as j:
            value = self.weighted.at(last, j)
            builder.assign({K.at(last, j): builder.read(value)})
        for i in reversed(range(last)):
            below = replace(self.factor.T.row(i), columns=last - i)
            below = replace(below, begin=below.begin + below.stride * (i + 1))
            rows = replace(K, rows=last - i, begin=K.step * (i + 1))
            multiply(builder, K.row(i), below, rows, self.weighted.row(i), less=True)
        return K

    def joseph(self, K: Dense) -> ca.SX:
        """(I - K C) P (I - K C)' + K R K', packed."""
        builder, (p, m) = self.builder, self.measurement.C.shape
        R = self.measurement.R
        unit = filled(builder, f"unit_{m}", ca.SX.eye(m))
        kept = room(builder, "kept", m, m)  # (I - K C)'
        multiply(builder, kept, self.sensed, K, unit, less=True)
        moved = room(builder, "kept_covariance", m, m)
        multiply(builder, moved, kept.T, self.covariance)
        noise = filled(builder, f"sensor_noise{self.tag}", R)
        through = room(builder, "noise_gain", p, m)
        multiply(builder, through, noise, K)
        left = room(builder, "corrected", m, m)
        multiply(builder, left, K.T, through, lower=True)
        multiply(builder, left, moved, kept, left, lower=True)
        return as_packed(builder, f"covariance{self.tag}", left)


def moved_mean(builder: PhaseBuilder, A: ca.SX, mean: ca.SX, tag: str) -> ca.SX:
    """A x."""
    if is_sparse(A):
        return A @ mean
    with builder.titled(_TITLE):
        row, transition = as_row(builder, "estimated_state", mean), _transition(builder, A, tag)
        found = multiply(builder, room(builder, f"next_state{tag}", 1, A.shape[0]), row, transition)
    return builder.symbol(found.name)[: A.shape[0]]


def moved_covariance(builder: PhaseBuilder, A: ca.SX, Q: ca.SX, P: ca.SX, tag: str) -> ca.SX:
    """A P A' + Q, packed, of a packed P."""
    n = A.shape[0]
    with builder.titled(_TITLE):
        noise = filled(builder, f"process_noise{tag}", Q)
        covariance = unpacked(builder, "estimated_covariance", P, n)
        half, found = room(builder, "half_moved", n, n), room(builder, "next_matrix", n, n)
        if is_sparse(A):
            turned = room(builder, "turned", n, n)
            transposed(builder, turned, combine(builder, half, A, covariance))
            combine(builder, found, A, turned, noise, lower=True)
        else:
            transition = _transition(builder, A, tag)
            multiply(builder, half, transition.T, covariance)
            multiply(builder, found, half, transition, noise, lower=True)
        return as_packed(builder, f"next_covariance{tag}", found)


def _transition(builder: PhaseBuilder, A: ca.SX, tag: str) -> Dense:
    return filled(builder, f"transition{tag}", A.T)
