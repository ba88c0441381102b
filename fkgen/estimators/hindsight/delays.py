"""Rows of y that were measured some samples ago, by a state that remembers what they would see.

Beside x the filter holds h = C x + D u + d of the last samples, for each row that may be late: that
is linear in the state, moves on without noise, and is what a late row measures (Anderson & Moore
1979, sec. 7.4, of the part of the state that is needed). Nothing is measured twice, noises of rows
that arrive together are correlated as R says, and the memory never grows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca

from fkgen.problem import Spec
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.interface import Kind, Outcome, Port, Status, triangle
from fkgen.symbolic.linalg import column, pack, sparse, unpack
from fkgen.symbolic.plant import Plant
from fkgen.symbolic.ports import carried, shown

#: Between two whole numbers.
HALF = 0.5

#: What names begin with of what belongs to a prediction, and to an update: of x, and of the past.
PREDICTED, FILTERED = ("predicted_", "predicted_"), ("filtered_", "")

#: Number of samples before this one, as far as it matters; mean and covariance of what is past.
AGE, MEAN, COVARIANCE = "samples_before", "past_signal", "past_covariance"
#: 1 for each row that counted, and 1 if none did: a row from before sample 0 does not.
COUNTED, NOTHING = "counted", "nothing_counted"


@dataclass(frozen=True, slots=True)
class Delays:
    """Which rows may be late, by how many samples at most."""

    rows: tuple[tuple[int, int, str], ...]  # Row of y, largest delay, the parameter that holds it
    n: int  # Rows of the covariance of x
    replayed: bool = False  # The last samples are gone through again instead

    @classmethod
    def of(cls, spec: Spec, *, replayed: bool = False) -> Delays:
        """Those of a spec; without any everything here is empty."""
        found = [
            (row, signal.max_delay, signal.delay)
            for row, signal in enumerate(spec.model.outputs)
            if signal.max_delay
        ]
        return cls(tuple(found), spec.model.ne, replayed)

    @property
    def size(self) -> int:
        """Number of signals that are remembered."""
        return 0 if self.replayed else sum(most for _, most, _ in self.rows)

    @property
    def notes(self) -> tuple[str, ...]:
        """What the header says."""
        if not self.size:
            return ()
        count = 2 * (self.size + self._covariance + 1)
        what = f"{self.size} signals of past samples are part of the state"
        return (f"late rows of y: {what}, {count} numbers of the instance",)

    @property
    def _covariance(self) -> int:
        """Entries of the joint covariance, packed, beyond those of x."""
        return len(triangle(self.n + self.size)) - len(triangle(self.n))

    @property
    def given(self) -> str:
        """The port that says which rows counted."""
        return COUNTED if self.rows else ""

    @property
    def outcomes(self) -> tuple[Outcome, ...]:
        """The status of a sample of which no row counted."""
        return (Outcome(Status.SKIPPED, NOTHING, HALF),) if self.rows else ()

    def ports(self, p: int) -> tuple[Port, ...]:
        """What is carried along, before and after an update, and which of p rows counted."""
        if not self.rows:
            return ()
        sizes = {AGE: (), MEAN: (self.size,), COVARIANCE: (self._covariance,)}
        meanings = {
            AGE: "samples before this one, as many as a row can be late at most",
            MEAN: "what late rows would see of past samples, given y[0..k{}]: by row, latest first",
            COVARIANCE: "its covariance with x, and of itself: the rows below that of x, packed",
        }
        own = (
            shown(COUNTED, (p,), "1 for each row that counted, else 0", inner=True),
            shown(NOTHING, (), "1 if no row counted, else 0", inner=True),
        )
        return own + tuple(
            carried(f"{of}{name}", shape, meanings[name].format(k), corrected=twin, inner=True)
            for of, k in (("predicted_", "-1"), ("", ""))
            for name, shape in sizes.items()
            if name == AGE or self.size
            for twin in [name if of else ""]
        )

    def joint(self, symbols: dict[str, ca.SX], of: tuple[str, str]) -> tuple[ca.SX, ca.SX]:
        """Mean and packed covariance of x and of what is remembered, before or after an update."""
        own = [symbols[f"{of[0]}{name}"] for name in ("state", "covariance")]
        if not self.size:
            return own[0], own[1]
        past = [symbols[f"{of[1]}{name}"] for name in (MEAN, COVARIANCE)]
        return ca.vertcat(own[0], past[0]), ca.vertcat(own[1], past[1])

    def split(self, state: ca.SX, covariance: ca.SX, of: tuple[str, str]) -> dict[str, ca.SX]:
        """What is assigned of both."""
        n, entries = state.numel() - self.size, len(triangle(self.n))
        found = {f"{of[0]}state": state[:n], f"{of[0]}covariance": covariance[:entries]}
        if self.size:
            found |= {f"{of[1]}{MEAN}": state[n:], f"{of[1]}{COVARIANCE}": covariance[entries:]}
        return found

    def not_negative(self, covariance: ca.SX) -> ca.SX:
        """The joint covariance without variances below zero, where rows have no noise."""
        found, at = ca.SX(covariance), self.n
        for _, most, _ in self.rows if self.size else ():
            latest = at * (at + 3) // 2
            found[latest] = ca.fmax(found[latest], 0)
            at += most
        return found

    def aged(self, symbols: dict[str, ca.SX], *, predicted: bool) -> dict[str, ca.SX]:
        """How many samples came before."""
        if not self.rows:
            return {}
        if not predicted:
            return {AGE: symbols[f"predicted_{AGE}"]}
        most = max(most for _, most, _ in self.rows)
        return {f"predicted_{AGE}": ca.fmin(symbols[AGE] + 1, most)}

    def counted(self, builder: PhaseBuilder, kept: tuple[ca.SX | None, ...]) -> dict[str, ca.SX]:
        """Which rows counted."""
        if not self.rows:
            return {}
        flags, none = [], builder.local("none_counted", 1, initial=1.0)
        for row, counts in enumerate(kept):
            name = f"counted_{row}"
            flags.append(builder.local(name, 1, initial=0.0))
            with builder.if_present(row, counts):
                builder.assign({name: ca.SX(1), "none_counted": ca.SX(0)})
        return {COUNTED: column(flags), NOTHING: none}

    def measured(
        self, builder: PhaseBuilder, plant: Plant, symbols: dict[str, ca.SX]
    ) -> tuple[Plant, tuple[ca.SX | None, ...]]:
        """The plant as y[k] sees it, and what is positive where a row counts as there.

        A row from before sample 0 does not.
        """
        if not self.rows:
            return plant, ()
        p, at = plant.ny, 0
        C, D, d = ca.SX(plant.C), ca.SX(plant.D), ca.SX(plant.d)
        seen = None if plant.seen is None else ca.SX(plant.seen)
        past = ca.SX(p, self.size)
        kept: list[ca.SX | None] = [None] * p
        for row, most, name in self.rows:
            delay = plant.parameters[name]
            with builder.titled(f"how late row {row} of y is, {plant.rows[row]}"):
                there = builder.local(f"delay_{row}", 1, initial=0.0)
                with builder.if_present(row):
                    limits = [delay, most - delay, ca.floor(delay) - delay]
                    builder.demand(Kind.NONNEGATIVE, limits, Status.PARAMETER_OUT_OF_RANGE)
                    builder.assign({f"delay_{row}": ca.densify(delay)})
                ages = column([_is_about(there, age) for age in range(most + 1)])
                late = builder.define(f"late_{row}", ages)
            kept[row] = counts = symbols[f"predicted_{AGE}"] - there + HALF
            late = ca.vertcat(late[0] + ca.SX(counts < 0), late[1:])
            C[row, :], D[row, :], d[row] = (late[0] * each[row, :] for each in (C, D, d))
            past[row, at : at + most] = late[1:].T
            if seen is not None:
                remembered = symbols[f"predicted_{MEAN}"][at : at + most]
                seen[row] = late[0] * seen[row] + ca.dot(late[1:], remembered)
            at += most
        A = ca.diagcat(plant.A, ca.SX(self.size, self.size))
        C = sparse(ca.horzcat(C, past))
        plant = replace(self._noisy(plant), A=A, C=C, D=sparse(D), d=sparse(d), seen=seen)
        return plant, tuple(kept)

    def moving(self, plant: Plant, symbols: dict[str, ca.SX]) -> Plant:
        """The plant that moves on what late rows would see of past samples, and adds this one."""
        if not self.size:
            return plant
        n, m, q, at = plant.ne, self.size, plant.nu, 0
        A, B, c = ca.SX(m, n + m), ca.SX(m, q), ca.SX(m, 1)
        moved = ca.SX(m, 1)
        for row, most, _ in self.rows:
            A[at, :n], B[at, :], c[at] = plant.C[row, :], plant.D[row, :], plant.d[row]
            for age in range(1, most):
                A[at + age, n + at + age - 1] = 1
            if plant.seen is not None:
                remembered = symbols[MEAN][at : at + most - 1]
                moved[at : at + most] = ca.vertcat(plant.seen[row], remembered)
            at += most
        found = replace(
            self._noisy(plant),
            A=sparse(ca.vertcat(ca.horzcat(plant.A, ca.SX(n, m)), A)),
            B=sparse(ca.vertcat(plant.B, B)),
            c=sparse(ca.vertcat(plant.c, c)),
        )
        if plant.moved is None:
            return found
        spread = None
        if plant.spread is not None:
            spread = pack(ca.diagcat(unpack(plant.spread, n), ca.SX(m, m)))
        return replace(found, moved=ca.vertcat(plant.moved, moved), spread=spread)

    def _noisy(self, plant: Plant) -> Plant:
        """The plant whose further states have no noise."""
        Q = ca.diagcat(plant.Q, ca.SX(self.size, self.size))
        return replace(plant, Q=Q, S=ca.vertcat(plant.S, ca.SX(self.size, plant.ny)))


def _is_about(delay: ca.SX, age: int) -> ca.SX:
    """1 where a delay, a whole number, is this one, else 0."""
    return ca.SX(delay < age + HALF) * ca.SX(delay > age - HALF)
