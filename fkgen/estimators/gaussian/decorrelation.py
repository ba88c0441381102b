"""LDL' elimination over the rows of y that are present: of measurement noise, and of S.

Eliminating row j from the rows below it subtracts a multiple of row j from each of them, so that
the noises left over are uncorrelated and rows can be processed one by one. A missing row is
skipped, which is the elimination of the R that is left without it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import casadi as ca

from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.index import At
from fkgen.symbolic.index import packed as place
from fkgen.symbolic.interface import Kind, Status
from fkgen.symbolic.linalg import column, diagonal, is_zero, sparse, total, unpack

LOG_TWO_PI = math.log(2.0 * math.pi)

#: Operations of one conditioning beyond which loops take the place of straight lines. So many fill
#: half of an instruction cache of 32 kB; from here on loops are as fast within a fifth (1.6
#: times as fast at six times as many), and their text does not grow with further rows.
STRAIGHT = 1400


def are_many(operations: float, times: float = 1.0) -> bool:
    """Whether operations are written in loops; those that have other costs, beyond a multiple."""
    return operations > times * STRAIGHT


def multiplied(pivots: Sequence[ca.SX], per_log: int) -> list[ca.SX]:
    """Products of so many pivots each, whose logarithms are taken."""
    chunks = -(-len(pivots) // per_log)
    found = [ca.SX(1)] * chunks
    for at, pivot in enumerate(pivots):
        chunk = at * chunks // len(pivots)
        found[chunk] = found[chunk] * pivot
    return found


def has_a_rule(at: tuple[int, ...]) -> bool:
    """Whether rows of y lie equally far apart, so that a loop finds them."""
    return len({after - before for before, after in pairwise(at)}) <= 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement:
    """y = C z + offset + w for the state z that is to be conditioned, Cov(w) = R."""

    C: ca.SX
    offset: ca.SX
    R: ca.SX
    y: ca.SX
    rows: tuple[str, ...]
    at: tuple[int, ...]  # which rows of y these are
    rank_tolerance: float | None  # for a singular R: rows that bring nothing new are left out
    shows_variance: bool  # S is shown, so it may as well give the innovations
    pivots_per_log: int  # so many may be multiplied before their logarithm
    S: ca.SX | None = None  # (m, p), covariance of z with w, if it has any
    predicted: ca.SX | None = None  # (p, 1), what is predicted of y in place of C z
    wraps: tuple[int, ...] = ()  # Rows that are angles
    code_form: str = "auto"  # Of the C code, as that of a plant
    #: What is positive where a row counts as there, if not whenever it is; empty for no row
    kept: tuple[ca.SX | None, ...] = ()

    #: Where the packed covariance of z, or its factors, are 0 by structure
    apart: tuple[int, ...] = ()

    def counts(self, row: int) -> ca.SX | None:
        """What is positive where a row that is there counts, if that is not always so."""
        return self.kept[row] if self.kept else None

    def only(self, rows: tuple[int, ...]) -> Measurement:
        """Some of the rows, as if there were no others."""
        which = list(rows)
        return replace(
            self,
            C=self.C[which, :],
            offset=self.offset[which],
            R=self.R[which, which],
            y=self.y[which],
            rows=tuple(self.rows[i] for i in which),
            at=tuple(self.at[i] for i in which),
            predicted=None if self.predicted is None else self.predicted[which],
            wraps=tuple(i for i, row in enumerate(which) if row in self.wraps),
            kept=tuple(self.kept[i] for i in which) if self.kept else (),
        )


@dataclass(frozen=True, slots=True)
class Row:
    """One decorrelated row."""

    c: ca.SX  # (m, 1), what it measures of the state
    innovation: ca.SX  # with respect to the prior
    variance: ca.SX  # of its noise
    of_y: ca.SX  # (p, 1), the combination of the rows of y that it is
    shared: ca.SX | None = None  # (m, 1), covariance of its noise with the state


def correlated_rows(covariances: Sequence[ca.SX]) -> tuple[tuple[int, ...], ...]:
    """Rows of y whose noises depend on each other in any of these R, in groups of two or more."""
    groups = [{i} for i in range(covariances[0].shape[0])]
    for R in covariances:
        for i, j in zip(*R.sparsity().get_triplet(), strict=True):
            if groups[i] is not groups[j]:
                groups[i] |= groups[j]
                for row in groups[i]:
                    groups[row] = groups[i]
    distinct = {min(group): tuple(sorted(group)) for group in groups if len(group) > 1}
    return tuple(distinct.values())


class Decorrelation:
    """The rows as far as noise is eliminated; a diagonal R passes through without a block."""

    def __init__(
        self, builder: PhaseBuilder, measurement: Measurement, innovation: list[ca.SX], tag: str
    ) -> None:
        p = measurement.C.shape[0]
        self.builder, self.measurement, self.tag = builder, measurement, tag
        self.C = [sparse(measurement.C[i, :].T) for i in range(p)]
        self.of_y = [ca.SX.eye(p)[:, i] for i in range(p)]
        self.e = list(innovation)
        S = measurement.S
        self.shared = [] if S is None else [sparse(S[:, i]) for i in range(p)]
        self.R = {(i, j): measurement.R[i, j] for i in range(p) for j in range(i + 1)}

    def row(self, i: int) -> Row:
        """Row i without the noise of the rows that were eliminated."""
        variance = self.R[i, i]
        if self.measurement.rank_tolerance is not None and not variance.is_constant():
            variance = ca.fmax(variance, 0)
        shared = self.shared[i] if self.shared else None
        return Row(self.C[i], self.e[i], variance, self.of_y[i], shared)

    def eliminate_all(self) -> None:
        """Take the noise of every row out of those below."""
        for j in range(len(self.C)):
            self.eliminate(j, self.measurement.counts(j))

    def eliminate(self, j: int, kept: ca.SX | None = None) -> None:
        """Take the noise of row j out of the rows below, where ``kept`` is positive."""
        builder, measurement, R, tag = self.builder, self.measurement, self.R, self.tag
        tolerance = measurement.rank_tolerance
        later = [i for i in range(j + 1, len(self.C)) if not is_zero(R[i, j])]
        if not later or is_zero(R[j, j]):
            return
        pivot, coupling = R[j, j], {i: R[i, j] for i in later}
        positive = None if tolerance is None else pivot - tolerance * measurement.R[j, j]
        if kept is not None:
            positive = kept if positive is None else ca.fmin(kept, positive)
        revised = partial(_revised, builder, (measurement.at[j], positive))
        with builder.titled(f"noise of {measurement.rows[j]} out of the rows below"):
            if tolerance is None:
                with builder.if_present(measurement.at[j]):
                    builder.demand(Kind.POSITIVE, [pivot], Status.NOT_POSITIVE_DEFINITE)
            for i in later:
                name = f"{tag}_{j}_{i}"
                share = builder.define(f"share{name}", coupling[i] / pivot)
                columns = [(self.C, "sensed"), (self.e, "decorrelated"), (self.of_y, "combined")]
                columns += [(self.shared, "shared_noise")] if self.shared else []
                for values, what in columns:
                    new = values[i] - share * values[j]
                    values[i] = revised(f"{what}{name}", values[i], new)
                for k in [k for k in later if k <= i]:
                    R[i, k] = revised(f"noise{name}_{k}", R[i, k], R[i, k] - share * coupling[k])


def _revised(
    builder: PhaseBuilder, when: tuple[int, ca.SX | None], name: str, old: ca.SX, new: ca.SX
) -> ca.SX:
    """The new value where a row is present and something positive, the old one elsewhere."""
    pattern = new.sparsity()
    if pattern.nnz() == 0:
        return new
    symbol = builder.local(name, pattern.nnz())
    builder.assign({name: ca.vertcat(ca.project(old, pattern).nz[:])})
    with builder.if_present(*when):
        builder.assign({name: ca.vertcat(new.nz[:])})
    return ca.SX(pattern, symbol)


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
        return total(e[j] * e[j] * inverse for j, inverse in enumerate(self.inverse))


def whiten(
    builder: PhaseBuilder,
    packed: ca.SX,
    columns: ca.SX,
    tag: str,
    *,
    kept: Sequence[ca.SX] = (),
    tolerance: float | None = None,
    least: float = 0.0,
) -> Whitened:
    """Write the blocks that eliminate S (packed) from ``columns`` (p, c).

    ``kept`` is positive where a row counts that is there; with a ``tolerance`` those do not of
    which so small a share of their variance is news. Where S is known to be positive definite a
    pivot that is not positive is rounding: it counts as the share ``least`` of its variance.
    """
    p = columns.shape[0]
    in_loops = are_many(p**4 / 3.0)  # each step in line goes through those before it again
    if in_loops and not kept and tolerance is None:
        return _whiten_in_loops(builder, packed, columns, tag, least)
    S, own = ca.SX(unpack(packed, p)), diagonal(packed)
    rows = [columns[i, :] for i in range(p)]
    inverses, logs = [], []
    for j in range(p):
        pivot = _at_least(S[j, j], own[j], least if j else 0.0)
        pivot = builder.define(f"whitening_pivot{tag}_{j}", pivot)
        inverse, log = f"whitening_inverse{tag}_{j}", f"whitening_log{tag}_{j}"
        inverses.append(builder.local(inverse, 1, initial=0.0))
        logs.append(builder.local(log, 1, initial=0.0))
        counts = kept[j] if kept else None
        if tolerance is not None:
            news = pivot - tolerance * own[j]
            counts = news if counts is None else ca.fmin(counts, news)
        with builder.if_present(j, counts):
            builder.demand(Kind.POSITIVE, [pivot], Status.NOT_POSITIVE_DEFINITE)
            builder.assign({inverse: 1 / pivot})
            builder.assign({log: ca.log(pivot) + LOG_TWO_PI})
        for i in range(j + 1, p):
            share = builder.define(f"whitening{tag}_{j}_{i}", S[i, j] * inverses[j])
            rows[i] = rows[i] - share * rows[j]
            for k in range(j + 1, i + 1):
                S[i, k] = S[i, k] - share * S[k, j]
    return Whitened(ca.vertcat(*rows), inverses, total(logs))


def _at_least(pivot: ca.SX, own: ca.SX, share: float) -> ca.SX:
    """A pivot; where it is not positive, a share of the variance that it is left of."""
    if share == 0.0:
        return pivot
    sound = pivot > 0
    return ca.SX.binary(ca.OP_IF_ELSE_ZERO, sound, pivot) + (1 - sound) * (share * own)


def _whiten_in_loops(
    builder: PhaseBuilder, packed: ca.SX, columns: ca.SX, tag: str, least: float
) -> Whitened:
    """The same elimination, of copies in arrays; columns lie one after the other."""
    p, c = columns.shape
    given = builder.array(f"whitening_variance{tag}", packed)
    names = S, e, inverse, coupling = tuple(
        f"whitening_{what}{tag}" for what in ("matrix", "columns", "inverses", "coupling")
    )
    sizes = (packed.numel(), p * c, p, p)
    _, found, inverses, _ = map(builder.local, names, sizes)
    log = builder.local(f"whitening_log{tag}", 1, initial=0.0)
    builder.assign({e: column(ca.vertsplit(ca.vec(ca.densify(columns))))})
    with builder.loop("i", 0, packed.numel()) as i:
        builder.assign({At(S, i): builder.at(given, i)})
    with builder.loop("j", 0, p) as j:
        kept, own = (builder.at(name, place(j, j)) for name in (S, given))
        pivot = builder.define(f"whitening_pivot{tag}", _at_least(kept, own, least))
        now = builder.define(
            f"whitening_row{tag}", column([builder.at(e, j + p * a) for a in range(c)])
        )
        builder.assign({At(inverse, j): ca.SX(0)})
        with builder.if_present(j):
            builder.demand(Kind.POSITIVE, [pivot], Status.NOT_POSITIVE_DEFINITE)
            builder.assign({At(inverse, j): 1 / pivot})
            builder.assign({f"whitening_log{tag}": log + (ca.log(pivot) + LOG_TWO_PI)})
            with builder.loop("i", j + 1, p) as i:
                builder.assign({At(coupling, i): builder.at(S, place(i, j))})
            with builder.loop("i", j + 1, p) as i:
                share = builder.define(
                    f"whitening_share{tag}", builder.at(coupling, i) * builder.at(inverse, j)
                )
                for a in range(c):
                    left = builder.at(e, i + p * a) - share * now[a]
                    builder.assign({At(e, i + p * a): left})
                with builder.loop("k", j + 1, i + 1) as k:
                    left = builder.at(S, place(i, k)) - share * builder.at(coupling, k)
                    builder.assign({At(S, place(i, k)): left})
    return Whitened(ca.reshape(found, p, c), ca.vertsplit(inverses), log)
