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
from fkgen.symbolic.dense import fill
from fkgen.symbolic.index import At, Whole, variable
from fkgen.symbolic.interface import Kind, Port, Status, triangle
from fkgen.symbolic.linalg import by_rows, column, from_rows, outer_lower, unpack
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
            passage.prepare()
            count = self.samples
            passage.ages = builder.table("ages", [float(age) for age in range(count)])
            with (
                builder.if_positive(longest - HALF),
                builder.loop("past", 0, count - 1) as past,
            ):
                age = count - 1 - past
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
        builder, n = self.builder, self.replay.delays.n
        entries = len(triangle(n))
        self.state = builder.local("replayed_state", n, initial=0.0)
        self.covariance = builder.local("replayed_covariance", entries, initial=0.0)
        self.mean, self.cross, self.own = self._signals("signal")
        builder.local("signal_seen", max(len(self.rows), 2), initial=0.0)
        self.nis = builder.local("late_nis", 1, initial=0.0)
        self.log_likelihood = builder.local("late_log_likelihood", 1, initial=0.0)

    def prepare(self) -> None:
        """Put late rows where loops find them."""
        builder, m = self.builder, len(self.rows)
        rows = {
            "late_flag": [self.late[row] for row in self.rows],
            "late_by": self.delay,
            "late_seen": [builder.symbol(f"row_{row}") for row in self.rows],
            "late_noise": [self.plant.R[row, row] for row in self.rows],
        }
        for name, values in rows.items():
            builder.local(name, max(m, 2), initial=0.0)
            with builder.if_positive(self.longest - HALF):
                builder.assign({name: _padded(column(values))})

    def _signals(self, name: str) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Variables for mean, covariance with the state and covariance of what late rows saw.

        Loops reach into them, so they are arrays, of two numbers at least.
        """
        n, m = self.replay.delays.n, len(self.rows)
        sizes = {name: m, f"{name}_cross": m * n, f"{name}_own": m * m}
        found = [
            self.builder.local(each, max(size, 2), initial=0.0)[:size]
            for each, size in sizes.items()
        ]
        return found[0], found[1], found[2]

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
        builder, replay, raw = self.builder, self.replay, self.replay.plant
        A, C, D, d = self.sampled([raw.A, raw.C, raw.D, raw.d], age)
        if replay.driven:
            d = D @ self.at(INPUTS, age, raw.nu) + d
        A, C, d = builder.name_all("replayed", (A, C, d))
        with _once(builder, value - self.longest + HALF, "first"):
            self.load(age)
        self.begin(C, d, value)
        names = [
            fill(builder, f"replayed_{of}", _entries(M)) for of, M in (("rows", C), ("offsets", d))
        ]
        p = raw.ny
        with builder.loop("b", 1, age + 1) as b:
            (noise,) = self.sampled([ca.diag(raw.R)], b)
            names.append(fill(builder, "replayed_noise", _entries(noise)))
            apart = builder.define("apart", value - builder.at(self.ages, b))
            with builder.loop("row", 0, p) as row:
                about = _is(builder.at(LATE, p * b + row), apart) - HALF
                with _once(builder, about, "there"):
                    c = self.row(names[0], row)
                    seen = builder.at(ROWS, p * b + row) - builder.at(names[1], row)
                    self.take(c, seen, builder.at(names[2], row))
        with builder.loop("q", 0, len(self.rows)) as q:
            along = builder.define("signal_row", self.row("signal_cross", q))
            self.put("signal_cross", q, A @ along)
        self.revise(age - 1, value)

    def load(self, age: Whole) -> None:
        """Take up a prediction as it was before this sample."""
        n = self.replay.delays.n
        self.copy("replayed_state", At(STATE, n * age), n)
        entries = len(triangle(n))
        self.copy("replayed_covariance", At(COVARIANCE, entries * age), entries)

    def copy(self, variable: str, kept: At, size: int, *, back: bool = False) -> None:
        """A variable from where a sample is kept, or back to there."""
        builder = self.builder
        if size == 1:
            here, there = builder.symbol(variable), builder.read(kept)
            builder.assign({kept: here} if back else {variable: there})
            return
        with builder.loop("i", 0, size) as i:
            own, other = At(variable, i), At(kept.name, kept.index + i)
            to, source = (other, own) if back else (own, other)
            builder.assign({to: builder.read(source)})

    def begin(self, C: ca.SX, d: ca.SX, value: ca.SX) -> None:
        """What late rows saw, at their sample."""
        builder, n, m = self.builder, self.replay.delays.n, len(self.rows)
        sensed = fill(builder, "late_rows", _entries(C[self.rows, :]))
        offsets = fill(builder, "late_offsets", _entries(d[self.rows, :]))
        with builder.loop("q", 0, m) as q:
            about = builder.at("late_flag", q) * _is(builder.at("late_by", q), value) - HALF
            with _once(builder, about, "begun"):
                c = builder.define("late_row", self.row(sensed, q))
                mean = ca.dot(c, self.state) + builder.at(offsets, q)
                seen = unpack(self.covariance, n) @ c
                builder.assign({At("signal", q): mean})
                self.put("signal_cross", q, seen)
                with builder.loop("j", 0, m) as j:
                    shared = ca.dot(self.row("signal_cross", j), c)
                    shared = builder.define("shared_signal", shared)
                    builder.assign({At("signal_own", m * q + j): shared})
                    builder.assign({At("signal_own", m * j + q): shared})

    def take(self, c: ca.SX, seen: ca.SX, variance: ca.SX) -> None:
        """Correct states, and what late rows saw, with a row of a past sample."""
        builder, n, m = self.builder, self.replay.delays.n, len(self.rows)
        c = builder.define("replayed_row", c)
        cross = builder.define("replayed_cross", unpack(self.covariance, n) @ c)
        pivot = builder.define("replayed_pivot", ca.dot(c, cross) + variance)
        builder.demand(Kind.POSITIVE, [pivot], Status.NOT_POSITIVE_DEFINITE)
        inverse = builder.define("replayed_inverse", 1 / pivot)
        weight = (seen - ca.dot(c, self.state)) * inverse
        weight = builder.define("replayed_weight", weight)
        builder.assign(
            {
                "replayed_state": self.state + cross * weight,
                "replayed_covariance": self.covariance - outer_lower(cross * inverse, cross),
            }
        )
        with builder.loop("q", 0, m) as q:
            builder.assign({At("signal_seen", q): ca.dot(self.row("signal_cross", q), c)})
        with builder.loop("q", 0, m) as q:
            own = builder.at("signal_seen", q)
            gain = builder.define("signal_gain", own * inverse)
            builder.assign({At("signal", q): builder.at("signal", q) + own * weight})
            self.put("signal_cross", q, self.row("signal_cross", q) - gain * cross)
            with builder.loop("j", 0, m) as j:
                left = builder.at("signal_own", m * q + j) - gain * builder.at("signal_seen", j)
                builder.assign({At("signal_own", m * q + j): left})

    def row(self, name: str, q: Whole) -> ca.SX:
        """One row of a matrix with n columns."""
        n = self.replay.delays.n
        return column([self.builder.at(name, n * q + i) for i in range(n)])

    def put(self, name: str, q: Whole, values: ca.SX) -> None:
        """The same, assigned."""
        n = self.replay.delays.n
        self.builder.assign({At(name, n * q + i): values[i] for i in range(n)})

    def revise(self, age: Whole, value: ca.SX) -> None:
        """Correct the prediction of the next sample with what is late and older."""
        builder, n, m = self.builder, self.replay.delays.n, len(self.rows)
        entries = len(triangle(n))
        self.load(age)
        if not builder.has("revised_state"):
            builder.local("revised_state", n, initial=0.0)
            builder.local("revised_covariance", entries, initial=0.0)
            self._signals("revised")
        builder.assign({"revised_state": self.state, "revised_covariance": self.covariance})
        self.set_out()
        x, P = builder.symbol("revised_state"), builder.symbol("revised_covariance")
        with builder.loop("q", 0, m) as q:
            older = builder.at("late_flag", q) * (builder.at("late_by", q) - value + HALF)
            with _once(builder, older, "older"):
                inverse, known, shared, _ = self.given_late(q)
                weight = builder.define("late_weight", known * inverse)
                cross = builder.define("late_cross", self.row("revised_cross", q))
                builder.assign(
                    {
                        "revised_state": x + cross * weight,
                        "revised_covariance": P - outer_lower(cross * inverse, cross),
                    }
                )
                with builder.loop("j", 0, m) as j:
                    share = builder.define("late_share", builder.at(shared, j) * inverse)
                    left = self.row("revised_cross", j) - share * cross
                    self.put("revised_cross", j, left)
        self.copy("revised_state", At(STATE, n * age), n, back=True)
        self.copy("revised_covariance", At(COVARIANCE, entries * age), entries, back=True)

    def set_out(self) -> None:
        """Late rows before any of them is taken in."""
        found = {"revised": self.mean, "revised_cross": self.cross, "revised_own": self.own}
        self.builder.assign({name: _padded(value) for name, value in found.items()})

    def given_late(self, q: Whole, tag: str = "") -> tuple[ca.SX, ca.SX, str, ca.SX]:
        """Take a late row in, as far as late rows go; 1/S, what is new of it, its row, and S."""
        builder, m = self.builder, len(self.rows)
        shared = f"late_shared{tag}"
        builder.local(shared, max(m, 2), initial=0.0)
        with builder.loop("j", 0, m) as j:
            builder.assign({At(shared, j): builder.at("revised_own", m * q + j)})
        pivot = builder.at("revised_own", m * q + q) + builder.at("late_noise", q)
        pivot = builder.define(f"late_pivot{tag}", pivot)
        builder.demand(Kind.POSITIVE, [pivot], Status.NOT_POSITIVE_DEFINITE)
        inverse = builder.define(f"late_inverse{tag}", 1 / pivot)
        known = builder.at("late_seen", q) - builder.at("revised", q)
        known = builder.define(f"late_news{tag}", known)
        with builder.loop("a", 0, m) as a:
            gain = builder.define(f"late_gain{tag}", builder.at(shared, a) * inverse)
            builder.assign({At("revised", a): builder.at("revised", a) + gain * known})
            with builder.loop("j", 0, m) as j:
                left = builder.at("revised_own", m * a + j) - gain * builder.at(shared, j)
                builder.assign({At("revised_own", m * a + j): left})
        return inverse, known, shared, pivot

    def judge(self) -> None:
        """How well the late rows fit what was known before this sample."""
        builder = self.builder
        self.set_out()
        flag = builder.at("late_flag", variable("q")) - HALF
        with builder.loop("q", 0, len(self.rows)) as q, _once(builder, flag, "late_row"):
            inverse, known, _, pivot = self.given_late(q, "_now")
            nis = known * known * inverse
            density = nis + ca.log(pivot) + LOG_TWO_PI
            builder.assign(
                {
                    "late_nis": self.nis + nis,
                    "late_log_likelihood": self.log_likelihood - 0.5 * density,
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
        own, cross = from_rows(self.own, m), from_rows(self.cross, m)
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


def _entries(matrix: ca.SX) -> list[ca.SX]:
    """The entries of a matrix by rows, for an array, which has two at least."""
    values = ca.vertsplit(by_rows(ca.SX(matrix)))
    return [*values, ca.SX(0)] if len(values) < 2 else values


def _padded(values: ca.SX) -> ca.SX:
    """A column that is an array, of two numbers at least."""
    return ca.densify(ca.vertcat(values, 0) if values.numel() < 2 else values)


def _is(value: ca.SX, whole: ca.SX) -> ca.SX:
    """1 where two whole numbers are the same, else 0."""
    return ca.SX(value < whole + HALF) * ca.SX(value > whole - HALF)
