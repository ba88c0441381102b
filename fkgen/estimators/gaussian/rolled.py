"""Conditioning on many rows of y in loops: the same operations as row by row, text that stays.

Written out, the elimination of noise grows with the third power of the number of rows, and all else
with the second. In loops a row is a symbolic one: what it measures, its innovation and the variance
of its noise are elements of arrays, and `SequentialUpdate` takes it in as any other row.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field

import casadi as ca

from fkgen.estimators.gaussian.decorrelation import (
    Measurement,
    Row,
    are_many,
    has_a_rule,
    multiplied,
)
from fkgen.estimators.gaussian.gate import HALF, Gate
from fkgen.estimators.gaussian.rows import Form, SequentialUpdate
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.dense import fill
from fkgen.symbolic.index import At, Index, Whole, packed, variable
from fkgen.symbolic.interface import Kind, Status
from fkgen.symbolic.linalg import column, pack

#: Rows with noises of their own need no elimination, and no S beside their updates: straight lines
#: are kept up to so many times the limit.
APART = 20.0
#: Loops know no zeros. Where they compute more than so many times what R needs, straight lines are
#: kept up to so many times the limit.
DENSER, SPARSE = 1.5, 6.0


def is_rolled(measurement: Measurement, *, with_gain: bool) -> bool:
    """Whether conditioning on these rows is written in loops."""
    (p, m), at, R = measurement.C.shape, measurement.at, measurement.R
    if measurement.code_form == "straight" or measurement.kept:
        return False
    if p < 2 or not has_a_rule(at):
        return False
    coupled = max(R.nnz() / p - 1.0, 0.0)
    seen = m if coupled > 0.0 else measurement.C.nnz() / p
    needed = operations(p, m, seen, coupled, with_gain=with_gain)
    dense = operations(p, m, m, p - 1.0 if coupled > 0.0 else 0.0, with_gain=with_gain)
    kept = APART if not coupled else 1.0 if dense <= DENSER * needed else SPARSE
    return are_many(needed, kept)


def operations(p: int, m: int, seen: float, coupled: float, *, with_gain: bool) -> float:
    """About how many operations p rows take, each of which sees so many of m states.

    ``coupled`` is with how many other rows the noise of each is correlated.
    """
    eliminated = p * coupled * (2.0 * seen + 2.0 * with_gain * p / 3.0 + 2.0 * coupled / 3.0) / 2.0
    variance = 2.0 * p * m * seen + p * (p + 1) * seen
    rows = p * (2.0 * m * seen + 2.0 * m * (m + 1) + with_gain * p * (seen + m))
    return eliminated + variance + rows


@dataclass(frozen=True, slots=True)
class Arrays:
    """What loops over the rows of a measurement work on, by what the variables are about.

    ``sensed`` and ``shared_noise`` hold entry k of row i at i + p k, so that rows lie side by side;
    ``noise`` holds R[i, j], i >= j, at i + p j, or its diagonal if it has no other entries.
    """

    builder: PhaseBuilder
    measurement: Measurement
    tag: str
    with_gain: bool
    known: dict[str, str] = field(default_factory=dict)  # Tables that are there under another name

    def name(self, what: str) -> str:
        """The variable of an array."""
        return self.known.get(what, f"rows_{what}{self.tag}")

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of rows and of what they measure."""
        p, m = self.measurement.C.shape
        return p, m

    @property
    def is_coupled(self) -> bool:
        """Whether noises of rows are correlated."""
        return any(
            i != j for i, j in zip(*self.measurement.R.sparsity().get_triplet(), strict=True)
        )

    def __getitem__(self, place: tuple[str, Whole]) -> ca.SX:
        """An element as it is read."""
        return self.builder.at(self.name(place[0]), place[1])

    def place(self, what: str, index: Whole) -> At:
        """An element as it is assigned."""
        return At(self.name(what), index)

    def column(self, what: str, j: Whole) -> ca.SX:
        """Row j of an array with rows side by side."""
        p, m = self.shape
        return column([self[what, j + p * k] for k in range(m)])

    def variance(self, j: Whole) -> ca.SX:
        """The variance of the noise of row j as far as it is eliminated."""
        return self["noise", (self.shape[0] + 1) * j if self.is_coupled else j]

    def if_present(self, j: Whole, positive: ca.SX | None = None) -> AbstractContextManager[None]:
        """Blocks written inside run only if row j is present, and a value positive."""
        return self.builder.if_present(self.row_of_y(j), positive)

    def row_of_y(self, j: Whole) -> Whole:
        """Which row of y row j is."""
        first, second, *_ = self.measurement.at
        return first + (second - first) * j

    def fill(self, what: str, values: Sequence[ca.SX], *, changes: bool = True) -> None:
        """Declare an array of these values; one of constants that never changes is a table."""
        name = self.name(what)
        self.known[what] = fill(self.builder, name, values, changes=changes)

    def fill_all(self, innovation: list[ca.SX]) -> None:
        """Declare and fill every array that loops start from."""
        builder, measurement, (p, m) = self.builder, self.measurement, self.shape
        C, R, S, coupled = measurement.C, measurement.R, measurement.S, self.is_coupled
        self.fill("sensed", [C[i, k] for k in range(m) for i in range(p)], changes=coupled)
        self.fill("decorrelated", innovation)
        if coupled:
            entries = [R[i, j] if i >= j else ca.SX(0) for j in range(p) for i in range(p)]
            self.fill("noise", entries)
        else:
            self.fill("noise", [R[i, i] for i in range(p)], changes=False)
        if measurement.rank_tolerance is not None:
            self.fill("own_noise", [R[i, i] for i in range(p)], changes=False)
        if S is not None:
            entries = [S[k, i] for k in range(m) for i in range(p)]
            self.fill("shared_noise", entries, changes=coupled)
        for what in ("coupling", "share"):
            builder.local(self.name(what), p)
        if self.with_gain:
            builder.local(self.name("combined"), p * p)
            with builder.loop("i", 0, p) as i:
                with builder.loop("k", 0, p) as k:
                    builder.assign({self.place("combined", p * i + k): ca.SX(0)})
                builder.assign({self.place("combined", (p + 1) * i): ca.SX(1)})

    def innovation_covariance(self, covariance: ca.SX) -> ca.SX:
        """S = C P C' + R, packed, before noise is eliminated."""
        builder, (p, _) = self.builder, self.shape
        S = builder.local(self.name("variance"), p * (p + 1) // 2)
        with builder.loop("i", 0, p) as i:
            product = covariance @ self.column("sensed", i)
            product = builder.define(f"sensed_covariance{self.tag}", product)
            with builder.loop("k", 0, i + 1 if self.is_coupled else i) as k:
                entry = ca.mtimes(product.T, self.column("sensed", k))
                if self.is_coupled:
                    entry += self["noise", i + p * k]
                builder.assign({self.place("variance", packed(i, k)): entry})
            if not self.is_coupled:
                entry = ca.mtimes(product.T, self.column("sensed", i)) + self["noise", i]
                builder.assign({self.place("variance", packed(i, i)): entry})
        return S

    def eliminate(self, j: Index, kept: ca.SX | None = None) -> None:
        """Take the noise of row j out of the rows below, where ``kept`` is positive."""
        builder, measurement, (p, m) = self.builder, self.measurement, self.shape
        tolerance, positive = measurement.rank_tolerance, kept
        pivot = builder.define(f"noise_pivot{self.tag}", self.variance(j))
        if tolerance is not None:
            certain = pivot - tolerance * self["own_noise", j]
            positive = certain if kept is None else ca.fmin(kept, certain)
        lists = ["sensed", *(["shared_noise"] if measurement.S is not None else [])]
        of_row = {
            what: builder.define(f"{what}_now{self.tag}", self.column(what, j)) for what in lists
        }
        e = builder.define(f"decorrelated_now{self.tag}", self["decorrelated", j])
        with self.if_present(j, positive):
            with builder.loop("i", j + 1, p) as i:
                if tolerance is None:
                    builder.demand(Kind.POSITIVE, [pivot], Status.NOT_POSITIVE_DEFINITE)
                coupling = self["noise", i + p * j]
                builder.assign({self.place("coupling", i): coupling})
                builder.assign({self.place("share", i): coupling / pivot})
            with builder.loop("i", j + 1, p) as i:
                new = {
                    self.place("decorrelated", i): self["decorrelated", i] - self["share", i] * e
                }
                for what, values in of_row.items():
                    for a in range(m):
                        old = self[what, i + p * a]
                        new[self.place(what, i + p * a)] = old - self["share", i] * values[a]
                for target, value in new.items():
                    builder.assign({target: value})
            with builder.loop("k", j + 1, p) as k, builder.loop("i", k, p) as i:
                less = self["share", i] * self["coupling", k]
                builder.assign({self.place("noise", i + p * k): self["noise", i + p * k] - less})
            if self.with_gain:
                with builder.loop("i", j + 1, p) as i, builder.loop("k", 0, j + 1) as k:
                    less = self["share", i] * self["combined", p * j + k]
                    builder.assign(
                        {self.place("combined", p * i + k): self["combined", p * i + k] - less}
                    )

    def row(self, j: Index) -> Row:
        """Row j without the noise of the rows that were eliminated."""
        seen = self.builder.define(f"row{self.tag}", self.column("sensed", j))
        variance = self.variance(j)
        if self.measurement.rank_tolerance is not None:
            variance = ca.fmax(variance, 0)
        variance = self.builder.define(f"row_noise{self.tag}", variance)
        shared = None if self.measurement.S is None else self.column("shared_noise", j)
        return Row(seen, self["decorrelated", j], variance, ca.SX(0, 1), shared)


@dataclass(slots=True, kw_only=True)
class RolledUpdate(SequentialUpdate):
    """A sequential update whose one row is that of the loop around it."""

    arrays: Arrays
    row_index: Index

    def label(self, _: int) -> str:
        """What names end with: they are those of every row."""
        return f"_row{self.tag}"

    def take(self, i: int, cross: ca.SX, innovation: ca.SX) -> None:
        """As any row; then what needs arrays: the pivots, and the gain."""
        SequentialUpdate.take(self, i, cross, innovation)
        builder, arrays, j = self.builder, self.arrays, self.row_index
        (p, m), seen = arrays.shape, self.rows[i].c
        builder.assign({arrays.place("pivots", j): self.pivot[i]})
        if not arrays.with_gain:
            return
        k = builder.define(f"row_gain{self.tag}", cross * builder.symbol(f"inverse{self.label(i)}"))
        with builder.loop("i", 0, j + 1) as q:
            old = column([arrays["gain", p * a + q] for a in range(m)])
            rest = arrays["combined", p * j + q] - ca.mtimes(seen.T, old)
            new = old + k * rest
            builder.assign({arrays.place("gain", p * a + q): new[a] for a in range(m)})


def taken_in_loops(
    arrays: Arrays,
    prior: tuple[ca.SX, ca.SX],
    innovation: list[ca.SX],
    form: Form,
    gate: Gate | None,
) -> SequentialUpdate:
    """The prior with all rows, taken in by loops; with a gate their noise leaves once they pass."""
    builder, measurement, (p, m) = arrays.builder, arrays.measurement, arrays.shape
    with builder.titled("rows of y as arrays"):
        arrays.fill_all(innovation)
    with builder.titled("covariance of the innovation"):
        S = arrays.innovation_covariance(prior[1])
    if gate is None and arrays.is_coupled:
        with (
            builder.titled("noise of every row out of the rows below"),
            builder.loop("j", 0, p - 1) as j,
        ):
            arrays.eliminate(j)
    builder.local(arrays.name("pivots"), p)
    if arrays.with_gain:
        builder.local(arrays.name("gain"), m * p)
        with builder.loop("i", 0, m * p) as i:
            builder.assign({arrays.place("gain", i): ca.SX(0)})
    rejected = builder.local(arrays.name("rejected"), p, initial=0.0) if gate else None
    with builder.titled("every row of y"):
        update = _begun(arrays, prior, form, gate)
        with builder.loop("j", 0, p) as j:
            update.rows = [arrays.row(j)]
            builder.assign({arrays.place("pivots", j): ca.SX(1)})
            update.update_row(0)
            if gate is not None:
                flag = update.rejected[0]
                builder.assign({arrays.place("rejected", j): flag})
                if arrays.is_coupled:
                    arrays.eliminate(j, HALF - flag)
    pivots = ca.vertsplit(builder.symbol(arrays.name("pivots")))
    update.determinant = multiplied(pivots, measurement.pivots_per_log)
    update.variance = S
    update.rejected = [] if rejected is None else ca.vertsplit(rejected)
    if arrays.with_gain:
        update.gain = ca.reshape(builder.symbol(arrays.name("gain")), p, m).T
    return update


def _begun(
    arrays: Arrays, prior: tuple[ca.SX, ca.SX], form: Form, gate: Gate | None
) -> RolledUpdate:
    """An update that goes on, in every round, from the variables that the one before it wrote."""
    builder, tag, measurement = arrays.builder, arrays.tag, arrays.measurement
    j = variable("j")
    update = RolledUpdate(
        builder=builder,
        rows=[],
        at=(arrays.row_of_y(j),),
        tag=tag,
        form=form,
        variance=arrays["variance", packed(j, j)],
        rank_tolerance=measurement.rank_tolerance,
        prior=prior[0],
        covariance=pack(prior[1]),
        gain=None,
        pivots_per_log=1,
        gate=gate,
        arrays=arrays,
        row_index=j,
    )
    update.determinant = [ca.SX(1)]
    update.mean, update.covariance = (
        update.symbols[f"{what}{tag}"] for what in ("mean", "covariance")
    )
    names = (f"quadratic{tag}", f"log_constant{tag}")
    update.nis, update.log_constant = (builder.local(name, 1, initial=0.0) for name in names)
    update.symbols |= dict(zip(names, (update.nis, update.log_constant), strict=True))
    return update
