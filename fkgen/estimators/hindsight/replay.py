"""Rows of y that were measured some samples ago, by going through the last samples once more.

The filter keeps the predictions of the last samples, with the rows that were measured then. A late
row sees h = C x + D u + d of its sample: from there on h is estimated along with the states, as the
kept rows correct them, which gives the covariance of h with x(k), and by it the prediction of
sample k that knows the late row. The predictions on the way are corrected with it too, so that the
next late row finds those of a filter that had this one in time. A sample without a late row costs
no more than what is kept. Noises of late rows are correlated with none of any other row.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import casadi as ca

from fkgen.estimators.gaussian.decorrelation import LOG_TWO_PI
from fkgen.estimators.gaussian.sequential import Conditioned
from fkgen.estimators.hindsight.delays import AGE, HALF, Delays
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.index import At, Whole
from fkgen.symbolic.interface import Kind, Port, Status, triangle
from fkgen.symbolic.linalg import by_rows, column, from_rows, outer_lower, pack, unpack
from fkgen.symbolic.plant import Plant
from fkgen.symbolic.ports import PARAMETER, carried

#: Of this sample and the last ones, the latest first: predictions, rows of y, how late they were
#: (-1: missing), inputs and parameters.
STATE, COVARIANCE, ROWS, LATE, INPUTS, PARAMETERS = (
    f"past_{name}" for name in ("state", "covariance", "rows", "delay", "inputs", "parameters")
)


@dataclass(frozen=True, slots=True)
class Replay:
    """What is kept of the last samples for late rows of a plant, as its rows are measured."""

    delays: Delays
    plant: Plant

    @property
    def samples(self) -> int:
        """Samples that are kept, this one among them."""
        return 1 + max(most for _, most, _ in self.delays.rows)

    @property
    def parameters(self) -> list[str]:
        """Parameters of past samples that are needed."""
        used = (self.plant.A, self.plant.C, self.plant.D, self.plant.d, self.plant.R)
        names = {each.name() for matrix in used for each in ca.symvar(matrix)}
        return [name for name in self.plant.parameters if name in names]

    @property
    def driven(self) -> bool:
        """Whether y depends on inputs."""
        return bool(self.plant.D.nnz())

    @property
    def notes(self) -> tuple[str, ...]:
        """What the header says."""
        count = sum(port.size for port in self.ports())
        what = f"predictions and rows of the last {self.samples - 1} samples are kept"
        return (f"late rows of y: {what}, {count} numbers of the instance",)

    def ports(self) -> tuple[Port, ...]:
        """What is kept."""
        n, p, count = self.delays.n, self.plant.ny, self.samples
        about = "of this sample and the last ones, the latest first"
        known = f"{about}, given the rows before each, late ones too"
        late = f"how late rows were {about}; -1 where they did not count"
        ports = (
            carried(STATE, (count, n), f"predictions {known}", unit="x", inner=True, prior="x"),
            carried(
                COVARIANCE,
                (count, n, n),
                f"their covariances {known}",
                unit="xx",
                symmetric=True,
                inner=True,
                prior="P",
            ),
            carried(ROWS, (count, p), f"rows of y {about}, 0 where missing", inner=True),
            carried(LATE, (count, p), late, inner=True, start=(-1.0,) * (count * p)),
            carried(INPUTS, (count, self.plant.nu * self.driven), f"inputs {about}", inner=True),
            carried(PARAMETERS, (count, len(self.parameters)), f"parameters {about}", inner=True),
        )
        return tuple(port for port in ports if port.size)

    def kept(
        self, builder: PhaseBuilder, plant: Plant, symbols: dict[str, ca.SX]
    ) -> dict[int, ca.SX]:
        """Keep this sample, and forget the oldest; 1 for each row that is late, else 0.

        ``plant`` has the parameters of this sample.
        """
        n, p, q = self.delays.n, plant.ny, plant.nu * self.driven
        when = {row: plant.parameters[name] for row, _, name in self.delays.rows}
        most = {row: most for row, most, _ in self.delays.rows}
        late = {row: builder.local(f"late_{row}", 1, initial=0.0) for row in when}
        for row in range(p):
            y, age = f"row_{row}", f"age_{row}"
            builder.local(y, 1, initial=0.0)
            builder.local(age, 1, initial=-1.0)
            delay = when.get(row, ca.SX(0))
            there = symbols[f"predicted_{AGE}"] - delay + HALF if row in when else None
            with builder.titled(f"how late row {row} of y is, {plant.rows[row]}"):
                if row in when:
                    with builder.if_present(row):
                        limits = [delay, most[row] - delay, ca.floor(delay) - delay]
                        builder.demand(Kind.NONNEGATIVE, limits, Status.PARAMETER_OUT_OF_RANGE)
                with builder.if_present(row, there):
                    builder.assign({y: symbols["y"][row], age: ca.densify(delay)})
                    if row in when:
                        builder.assign({f"late_{row}": ca.SX(delay > HALF)})
        entries = len(triangle(n))
        own = {
            STATE: (symbols["predicted_state"], n),
            COVARIANCE: (symbols["predicted_covariance"], entries),
            ROWS: (column([builder.symbol(f"row_{row}") for row in range(p)]), p),
            LATE: (column([builder.symbol(f"age_{row}") for row in range(p)]), p),
        }
        if q:
            own[INPUTS] = symbols["u"], q
        if names := self.parameters:
            now = column([symbols[PARAMETER + name] for name in names])
            own[PARAMETERS] = now, len(names)
        with builder.titled("the last samples"):
            builder.assign(
                {
                    name: ca.vertcat(now, symbols[name][: (self.samples - 1) * size])
                    for name, (now, size) in own.items()
                }
            )
        return late

    def corrected(self, builder: PhaseBuilder, plant: Plant, late: dict[int, ca.SX]) -> _Passage:
        """Go through the last samples with the rows that are late; predictions know them then."""
        passage = _Passage(self, builder, plant, late)
        with builder.titled("the last samples once more, for what is late"):
            longest = ca.SX(0)
            for row, _, name in self.delays.rows:
                longest = ca.fmax(longest, plant.parameters[name] * late[row])
            passage.longest = longest = builder.define("longest_delay", longest)
            count = self.samples
            passage.ages = builder.table("ages", [float(age) for age in range(count)])
            with (
                builder.if_positive(longest - HALF),
                builder.loop("i", 0, count - 1) as i,
            ):
                age = count - 1 - i
                value = builder.define("replayed_age", builder.at(passage.ages, age))
                with _once(builder, longest - value + HALF, "once"):
                    passage.pass_over(age, value)
            with _once(builder, longest - HALF, "once"):
                passage.judge()
        return passage


@contextmanager
def _once(builder: PhaseBuilder, positive: ca.SX, index: str) -> Iterator[None]:
    """What is written inside runs if a value is positive, and may have conditions of its own."""
    with builder.if_positive(positive), builder.loop(index, 0, 1):
        yield


@dataclass(slots=True)
class _Passage:
    """Builder of the way from a past sample to this one, along with what late rows saw."""

    replay: Replay
    builder: PhaseBuilder
    plant: Plant
    late: dict[int, ca.SX]
    longest: ca.SX = field(default_factory=lambda: ca.SX(0))
    ages: str = "ages"  # The table of whole numbers
    state: ca.SX = field(init=False)
    covariance: ca.SX = field(init=False)
    #: Of what late rows saw: mean, covariance with the state, packed covariance
    mean: ca.SX = field(init=False)
    cross: ca.SX = field(init=False)
    own: ca.SX = field(init=False)
    nis: ca.SX = field(init=False)
    log_likelihood: ca.SX = field(init=False)

    def __post_init__(self) -> None:
        n, m = self.replay.delays.n, len(self.rows)
        builder, entries = self.builder, len(triangle(n))
        self.state = builder.local("replayed_state", n, initial=0.0)
        self.covariance = builder.local("replayed_covariance", entries, initial=0.0)
        self.mean = builder.local("signal", m, initial=0.0)
        self.cross = builder.local("signal_cross", m * n, initial=0.0)
        self.own = builder.local("signal_covariance", len(triangle(m)), initial=0.0)
        self.nis = builder.local("late_nis", 1, initial=0.0)
        self.log_likelihood = builder.local("late_log_likelihood", 1, initial=0.0)

    @property
    def rows(self) -> list[int]:
        """Rows of y that may be late."""
        return [row for row, _, _ in self.replay.delays.rows]

    @property
    def delay(self) -> list[ca.SX]:
        """How late they are."""
        return [self.plant.parameters[name] for _, _, name in self.replay.delays.rows]

    def at(self, name: str, age: Whole, size: int) -> ca.SX:
        """What is kept of a sample."""
        return column([self.builder.at(name, size * age + i) for i in range(size)])

    def sampled(self, matrices: Sequence[ca.SX], age: Whole) -> list[ca.SX]:
        """Matrices with the parameters of a past sample."""
        names = self.replay.parameters
        symbols = [self.plant.parameters[name] for name in names]
        values = ca.vertsplit(self.at(PARAMETERS, age, len(names))) if names else []
        found: list[ca.SX] = ca.substitute(list(matrices), symbols, values)
        return found

    def pass_over(self, age: Whole, value: ca.SX) -> None:
        """From a past sample to the next one."""
        builder, replay = self.builder, self.replay
        raw = replay.plant
        A, C, D, d = self.sampled([raw.A, raw.C, raw.D, raw.d], age)
        if replay.driven:
            d = D @ self.at(INPUTS, age, raw.nu) + d
        A, C, d = builder.name_all("replayed", (A, C, d))
        with _once(builder, value - self.longest + HALF, "first"):
            self.load(age)
        for q, row in enumerate(self.rows):
            about = self.late[row] * _is(self.delay[q], value) - HALF
            with _once(builder, about, "begun"):
                self.begin(q, C[row, :], d[row])
        for row in range(raw.ny):
            c = C[row, :].T
            if row not in self.rows:
                with _once(builder, self.at_one(LATE, age, row) + HALF, "there"):
                    variance = self.sampled([raw.R[row, row]], age)[0]
                    self.take(f"_{row}", c, self.at_one(ROWS, age, row) - d[row], variance)
                continue
            with builder.loop("b", 1, age + 1) as b:
                apart = value - builder.at(self.ages, b)
                with _once(builder, _is(self.at_one(LATE, b, row), apart) - HALF, "there"):
                    variance = self.sampled([raw.R[row, row]], b)[0]
                    self.take(f"_{row}", c, self.at_one(ROWS, b, row) - d[row], variance)
        self.move(A)
        self.revise(age - 1, value)

    def load(self, age: Whole) -> None:
        """Take up a prediction as it was before this sample."""
        n = self.replay.delays.n
        self.builder.assign(
            {
                "replayed_state": self.at(STATE, age, n),
                "replayed_covariance": self.at(COVARIANCE, age, len(triangle(n))),
            }
        )

    def at_one(self, name: str, age: Whole, row: int) -> ca.SX:
        """What is kept of one row."""
        return self.builder.at(name, self.plant.ny * age + row)

    def begin(self, q: int, c: ca.SX, offset: ca.SX) -> None:
        """What a late row saw, at its sample."""
        m = len(self.rows)
        seen = unpack(self.covariance, self.replay.delays.n) @ c.T
        cross, own = from_rows(self.cross, m), unpack(self.own, m)
        for j in range(m):
            own[q, j] = own[j, q] = ca.mtimes(cross[j, :], c.T)
        own[q, q] = ca.mtimes(c, seen)
        cross[q, :] = seen.T
        mean = ca.SX(self.mean)
        mean[q] = ca.mtimes(c, self.state) + offset
        self.builder.assign(
            {"signal": mean, "signal_cross": by_rows(cross), "signal_covariance": pack(own)}
        )

    def take(self, tag: str, c: ca.SX, seen: ca.SX, variance: ca.SX) -> None:
        """Correct states, and what late rows saw, with a row of a past sample."""
        builder, n, m = self.builder, self.replay.delays.n, len(self.rows)
        cross = builder.define(f"replayed_cross{tag}", unpack(self.covariance, n) @ c)
        pivot = builder.define(f"replayed_pivot{tag}", ca.mtimes(c.T, cross) + variance)
        builder.demand(Kind.POSITIVE, [pivot], Status.NOT_POSITIVE_DEFINITE)
        inverse = builder.define(f"replayed_inverse{tag}", 1 / pivot)
        weight = (seen - ca.mtimes(c.T, self.state)) * inverse
        weight = builder.define(f"replayed_weight{tag}", weight)
        along = from_rows(self.cross, m)
        own = builder.define(f"signal_seen{tag}", along @ c)
        gain = own * inverse
        builder.assign(
            {
                "replayed_state": self.state + cross * weight,
                "replayed_covariance": self.covariance - outer_lower(cross * inverse, cross),
                "signal": self.mean + own * weight,
                "signal_cross": by_rows(along - gain @ cross.T),
                "signal_covariance": self.own - outer_lower(gain, own),
            }
        )

    def move(self, A: ca.SX) -> None:
        """The covariances of what late rows saw with the state of the next sample."""
        moved = from_rows(self.cross, len(self.rows)) @ A.T
        self.builder.assign({"signal_cross": by_rows(moved)})

    def revise(self, age: Whole, value: ca.SX) -> None:
        """Correct the prediction of the next sample with what is late and older."""
        builder, n, m = self.builder, self.replay.delays.n, len(self.rows)
        entries, count = len(triangle(n)), range(m)
        self.load(age)
        start = {
            "revised_state": self.state,
            "revised_covariance": self.covariance,
            "revised_signal": self.mean,
            "revised_cross": self.cross,
            "revised_own": self.own,
        }
        for name, begun in start.items():
            if not builder.has(name):
                builder.local(name, begun.numel(), initial=0.0)
        builder.assign(start)
        x, P, h, along, own = (builder.symbol(name) for name in start)
        for q in count:
            row = self.rows[q]
            older = self.late[row] * (self.delay[q] - value + HALF)
            with _once(builder, older, "older"):
                whole = unpack(own, m)
                pivot = builder.define(f"late_pivot_{q}", whole[q, q] + self.plant.R[row, row])
                builder.demand(Kind.POSITIVE, [pivot], Status.NOT_POSITIVE_DEFINITE)
                inverse = builder.define(f"late_inverse_{q}", 1 / pivot)
                weight = (builder.symbol(f"row_{row}") - h[q]) * inverse
                weight = builder.define(f"late_weight_{q}", weight)
                rows = from_rows(along, m)
                cross, shared = rows[q, :].T, whole[:, q]
                builder.assign(
                    {
                        "revised_state": x + cross * weight,
                        "revised_covariance": P - outer_lower(cross * inverse, cross),
                        "revised_signal": h + shared * weight,
                        "revised_cross": by_rows(rows - (shared * inverse) @ cross.T),
                        "revised_own": own - outer_lower(shared * inverse, shared),
                    }
                )
        builder.assign({At(STATE, n * age + i): x[i] for i in range(n)})
        builder.assign({At(COVARIANCE, entries * age + i): P[i] for i in range(entries)})

    def judge(self) -> None:
        """How well the late rows fit what was known before this sample."""
        builder, m = self.builder, len(self.rows)
        builder.assign({"revised_signal": self.mean, "revised_own": self.own})
        h, own = builder.symbol("revised_signal"), builder.symbol("revised_own")
        for q, row in enumerate(self.rows):
            y = builder.symbol(f"row_{row}")
            with _once(builder, self.late[row] - HALF, "late_row"):
                whole = unpack(own, m)
                pivot = builder.define(f"late_pivot_{q}_now", whole[q, q] + self.plant.R[row, row])
                inverse = builder.define(f"late_inverse_{q}_now", 1 / pivot)
                known = builder.define(f"late_given_before_{q}", y - h[q])
                nis = known * known * inverse
                shared = whole[:, q]
                builder.assign(
                    {
                        "late_nis": self.nis + nis,
                        "late_log_likelihood": self.log_likelihood
                        - 0.5 * (nis + ca.log(pivot) + LOG_TWO_PI),
                        "revised_signal": h + shared * (known * inverse),
                        "revised_own": own - outer_lower(shared * inverse, shared),
                    }
                )

    def prior(self) -> tuple[ca.SX, ca.SX]:
        """The prediction of this sample that knows what is late."""
        n = self.replay.delays.n
        state, covariance = self.builder.symbol(STATE), self.builder.symbol(COVARIANCE)
        return state[:n], covariance[: len(triangle(n))]

    def counts(self, row: int) -> ca.SX | None:
        """What is positive where a row that is there is one of this sample."""
        if row not in self.late:
            return None
        return ca.fmin(HALF - self.late[row], self.counted(row))

    def counted(self, row: int) -> ca.SX:
        """What is positive where a row counts, late or not."""
        return self.builder.symbol(f"age_{row}") + HALF

    def results(self, found: Conditioned, symbols: dict[str, ca.SX]) -> dict[str, ca.SX]:
        """Innovations, and how well they fit, of late rows with the others.

        They are about what was known before this sample.
        """
        builder, plant, p = self.builder, self.plant, self.plant.ny
        own = {"all_innovations": found.innovation, "all_variances": found.innovation_covariance}
        for name, value in own.items():
            builder.local(name, value.numel(), initial=0.0)
        builder.assign(own)
        with (
            builder.titled("innovations about what was known before this sample"),
            _once(builder, self.longest - HALF, "once"),
        ):
            moved = self.prior()[0] - symbols["predicted_state"]
            for row in range(p):
                known = found.innovation[row] + ca.mtimes(plant.C[row, :], moved)
                with builder.if_present(row, self.counts(row)):
                    self._put(row, known)
                if row in self.late:
                    with builder.if_positive(self.late[row] - HALF):
                        q = self.rows.index(row)
                        self._put(row, builder.symbol(f"row_{row}") - self.mean[q])
            builder.assign({"all_variances": self._covariance(symbols["predicted_covariance"])})
        return {
            "innovation": builder.symbol("all_innovations"),
            "innovation_covariance": builder.symbol("all_variances"),
            "nis": found.nis + self.nis,
            "log_likelihood": found.log_likelihood + self.log_likelihood,
        }

    def _put(self, row: int, innovation: ca.SX) -> None:
        """The innovation of one row."""
        many = self.plant.ny > 1
        self.builder.assign({At("all_innovations", row) if many else "all_innovations": innovation})

    def _covariance(self, prior: ca.SX) -> ca.SX:
        """The covariance of innovations about what was known before this sample, packed."""
        plant, m = self.plant, len(self.rows)
        own, cross = unpack(self.own, m), from_rows(self.cross, m)
        items = {row: q for q, row in enumerate(self.rows)}
        seen = plant.C @ unpack(prior, self.replay.delays.n)
        entries = []
        for i, j in triangle(plant.ny):
            value = ca.mtimes(seen[i, :], plant.C[j, :].T)
            for a, b in ((i, j), (j, i)):
                if a in items and a != b:
                    other = ca.mtimes(cross[items[a], :], plant.C[b, :].T)
                    alone = self.late[a] * (1 - self.late.get(b, ca.SX(0)))
                    value += alone * (other - value)
            if i in items and j in items:
                value += self.late[i] * self.late[j] * (own[items[i], items[j]] - value)
            entries.append(value + plant.R[i, j])
        return column(entries)


def _is(value: ca.SX, whole: ca.SX) -> ca.SX:
    """1 where two whole numbers are the same, else 0."""
    return ca.SX(value < whole + HALF) * ca.SX(value > whole - HALF)
