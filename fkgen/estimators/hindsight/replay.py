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
from functools import partial

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
from fkgen.symbolic.ports import PARAMETER, carried, shown

#: Of this sample and the last ones, each in the place of one that is forgotten: predictions, rows
#: of y, how late they were (-1: missing), inputs and parameters.
STATE, COVARIANCE, ROWS, LATE, INPUTS, PARAMETERS = (
    f"past_{name}" for name in ("state", "covariance", "rows", "delay", "inputs", "parameters")
)
#: The place of the next sample, and 1 for each place that this one wrote.
PLACE, WRITTEN = "past_place", "past_written"


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
    def beside(self) -> dict[str, int]:
        """What is kept beside predictions, and how many numbers of each sample."""
        nu, names = self.plant.nu * self.driven, self.parameters
        sizes = {ROWS: self.plant.ny, LATE: self.plant.ny, INPUTS: nu, PARAMETERS: len(names)}
        return {name: size for name, size in sizes.items() if size}

    @property
    def notes(self) -> tuple[str, ...]:
        """What the header says."""
        count = sum(port.size for port in self.ports())
        what = f"predictions and rows of the last {self.samples - 1} samples are kept"
        return (f"late rows of y: {what}, {count} numbers of the instance",)

    def ports(self) -> tuple[Port, ...]:
        """What is kept; arrays of samples come last."""
        n, p, count = self.delays.n, self.plant.ny, self.samples
        about = f"of this sample and the last ones, which take {count} places in turn"
        known = f"{about}, given the rows before each, late ones too"
        late = f"how late rows were {about}; -1 where they did not count"
        kept = partial(carried, inner=True, slots=WRITTEN)
        ports = (
            carried(PLACE, (), "place of the next sample among those that are kept", inner=True),
            shown(WRITTEN, (count,), "1 for each place that this sample wrote, else 0", inner=True),
            kept(STATE, (count, n), f"predictions {known}", unit="x", prior="x"),
            kept(
                COVARIANCE,
                (count, n, n),
                f"their covariances {known}",
                unit="xx",
                symmetric=True,
                prior="P",
            ),
            kept(ROWS, (count, p), f"rows of y {about}, 0 where missing"),
            kept(LATE, (count, p), late, start=(-1.0,) * (count * p)),
            kept(INPUTS, (count, self.plant.nu * self.driven), f"inputs {about}"),
            kept(PARAMETERS, (count, len(self.parameters)), f"parameters {about}"),
        )
        return tuple(port for port in ports if port.size)

    def kept(
        self, builder: PhaseBuilder, plant: Plant, symbols: dict[str, ca.SX]
    ) -> dict[int, ca.SX]:
        """Keep this sample, and forget the oldest; 1 for each row that is late, else 0.

        ``plant`` has the parameters of this sample.
        """
        p = plant.ny
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
        with builder.titled("this sample in the place of the one that is forgotten"):
            places = builder.table("places", [float(place) for place in range(self.samples)])
            with builder.loop("slot", 0, self.samples) as slot:
                here = _is(builder.at(places, slot), symbols[PLACE])
                builder.assign({At(WRITTEN, slot): here})
                with builder.if_positive(here - HALF):
                    builder.assign(self._own(builder, plant, symbols, slot))
        return late

    def _own(
        self, builder: PhaseBuilder, plant: Plant, symbols: dict[str, ca.SX], slot: Whole
    ) -> dict[At, ca.SX]:
        """What is kept of this sample, at its place."""
        own = {
            STATE: symbols["predicted_state"],
            COVARIANCE: symbols["predicted_covariance"],
            ROWS: column([builder.symbol(f"row_{row}") for row in range(plant.ny)]),
            LATE: column([builder.symbol(f"age_{row}") for row in range(plant.ny)]),
        }
        if self.driven:
            own[INPUTS] = symbols["u"]
        if names := self.parameters:
            own[PARAMETERS] = column([symbols[PARAMETER + name] for name in names])
        return {
            At(name, values.numel() * slot + i): values[i]
            for name, values in own.items()
            for i in range(values.numel())
        }

    def corrected(
        self,
        builder: PhaseBuilder,
        plant: Plant,
        late: dict[int, ca.SX],
        symbols: dict[str, ca.SX],
    ) -> _Passage:
        """Go through the last samples with the rows that are late; predictions know them then."""
        longest = ca.SX(0)
        for row, _, name in self.delays.rows:
            longest = ca.fmax(longest, plant.parameters[name] * late[row])
        with builder.titled("what was predicted, and how late rows are at most"):
            longest = builder.define("longest_delay", longest)
            passage = _Passage(self, builder, plant, late, longest, symbols)
        with (
            builder.titled("what is late, where loops find it"),
            _once(builder, longest - HALF, "once", rare=True),
        ):
            passage.prepare()
        with (
            builder.titled("the last samples once more, for what is late"),
            _once(builder, longest - HALF, "once", rare=True),
        ):
            place, count = symbols[PLACE], self.samples
            with builder.loop("turn", 0, 2) as turn, builder.loop("slot", 0, count) as slot:
                before = place - builder.at("places", slot)  # samples, in the second turn
                age = builder.define("age", before + count * (1 - builder.at("places", turn)))
                with _once(builder, ca.fmin(longest - age, age) + HALF, "visited"):
                    passage.visit(slot, age)
        with (
            builder.titled("what late rows tell, about what was known before this sample"),
            _once(builder, longest - HALF, "once", rare=True),
        ):
            passage.judge()
            passage.tell()
        return passage


@contextmanager
def _once(
    builder: PhaseBuilder, positive: ca.SX, index: str, *, rare: bool = False
) -> Iterator[None]:
    """What is written inside runs if a value is positive, and may have conditions of its own."""
    with builder.if_positive(positive, rare=rare), builder.loop(index, 0, 1):
        yield


@dataclass(slots=True)
class _Passage:
    """Builder of the way from a past sample to this one, along with what late rows saw."""

    replay: Replay
    builder: PhaseBuilder
    plant: Plant
    late: dict[int, ca.SX]
    longest: ca.SX
    symbols: dict[str, ca.SX]
    state: ca.SX = field(init=False)
    covariance: ca.SX = field(init=False)
    #: Of what late rows saw: mean, covariance with the state, packed covariance
    mean: ca.SX = field(init=False)
    cross: ca.SX = field(init=False)
    own: ca.SX = field(init=False)
    nis: ca.SX = field(init=False)
    log_likelihood: ca.SX = field(init=False)

    def __post_init__(self) -> None:
        builder, n, p = self.builder, self.replay.delays.n, self.plant.ny
        entries = len(triangle(n))
        predicted = (self.symbols[f"predicted_{name}"] for name in ("state", "covariance"))
        sizes = {"known_state": n, "known_covariance": entries}
        for name, size in sizes.items():
            builder.local(name, size)
        builder.assign(dict(zip(sizes, predicted, strict=True)))
        self.state = builder.local("old_x", n, initial=0.0)
        self.covariance = builder.local("old_P", entries, initial=0.0)
        self.mean, self.cross, self.own = self._signals("signal")
        builder.local("signal_seen", max(len(self.rows), 2), initial=0.0)
        self.nis = builder.local("late_nis", 1, initial=0.0)
        self.log_likelihood = builder.local("late_log_likelihood", 1, initial=0.0)
        builder.local("late_innovation", p, initial=0.0)
        builder.local("late_variances", len(triangle(p)), initial=0.0)

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

    def visit(self, slot: Whole, age: ca.SX) -> None:
        """Correct the prediction of a sample with what is late and older, and go to the next."""
        builder = self.builder
        now = HALF - age
        with _once(builder, now, "own"):
            state, covariance = (
                self.symbols["predicted_state"],
                self.symbols["predicted_covariance"],
            )
            builder.assign({"old_x": state, "old_P": covariance})
        with _once(builder, -now, "past"):
            self.copy_kept(slot)
        with _once(builder, self.longest - age - HALF, "later"):
            self.revise(slot, age)
        with _once(builder, -now, "past"):
            self.pass_over(slot, age)

    def copy_kept(self, slot: Whole) -> None:
        """Take up what is kept of a sample."""
        n, entries = self.replay.delays.n, len(triangle(self.replay.delays.n))
        self.copy(At("old_x", 0), At(STATE, n * slot), n)
        self.copy(At("old_P", 0), At(COVARIANCE, entries * slot), entries)

    def pass_over(self, slot: Whole, age: ca.SX) -> None:
        """From a past sample to the next one."""
        builder, replay, raw = self.builder, self.replay, self.replay.plant
        A, C, D, d = self.sampled([raw.A, raw.C, raw.D, raw.d], slot)
        if replay.driven:
            d = D @ self.at(INPUTS, slot, raw.nu) + d
        A, C, d = builder.name_all("replayed", (A, C, d))
        self.begin(C, d, age)
        names = [
            fill(builder, f"replayed_{of}", _entries(M)) for of, M in (("rows", C), ("offsets", d))
        ]
        p = raw.ny
        with builder.loop("other", 0, replay.samples) as other:
            ahead = self.symbols[PLACE] - builder.at("places", other)
            came = builder.define("came_before", ahead + replay.samples * ca.SX(ahead < -HALF))
            apart = builder.define("apart", age - came)
            with _once(builder, ca.fmin(came - HALF, apart + HALF), "came"):
                (noise,) = self.sampled([ca.diag(raw.R)], other)
                names.append(fill(builder, "replayed_noise", _entries(noise)))
                with builder.loop("row", 0, p) as row:
                    about = _is(builder.at(LATE, p * other + row), apart) - HALF
                    with _once(builder, about, "there"):
                        c = self.row(names[0], row)
                        seen = builder.at(ROWS, p * other + row) - builder.at(names[1], row)
                        self.take(c, seen, builder.at(names[2], row))
        with builder.loop("q", 0, len(self.rows)) as q:
            along = builder.define("signal_row", self.row("signal_cross", q))
            self.put("signal_cross", q, A @ along)

    def copy(self, to: At, source: At, size: int) -> None:
        """Some numbers from one array to another; a variable of one number is none."""
        builder = self.builder
        if size == 1:
            one = [each.name if isinstance(each.index, int) else each for each in (to, source)]
            value = builder.symbol(one[1]) if isinstance(one[1], str) else builder.read(source)
            builder.assign({one[0]: value})
            return
        with builder.loop("i", 0, size) as i:
            value = builder.read(At(source.name, source.index + i))
            builder.assign({At(to.name, to.index + i): value})

    def begin(self, C: ca.SX, d: ca.SX, value: ca.SX) -> None:
        """What late rows saw, at their sample."""
        builder, n, m = self.builder, self.replay.delays.n, len(self.rows)
        sensed = fill(builder, "late_rows", _entries(C[self.rows, :]))
        offsets = fill(builder, "late_offsets", _entries(d[self.rows, :]))
        with builder.loop("q", 0, m) as q:
            about = builder.at("late_flag", q) * _is(builder.at("late_by", q), value) - HALF
            with _once(builder, about, "begun"):
                c = builder.define("late_c", self.row(sensed, q))
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
        c = builder.define("own_c", c)
        cross = builder.define("old_Pc", unpack(self.covariance, n) @ c)
        pivot = builder.define("replayed_pivot", ca.dot(c, cross) + variance)
        builder.demand(Kind.POSITIVE, [pivot], Status.NOT_POSITIVE_DEFINITE)
        inverse = builder.define("inverse", 1 / pivot)
        weight = (seen - ca.dot(c, self.state)) * inverse
        weight = builder.define("weight", weight)
        builder.assign(
            {
                "old_x": self.state + cross * weight,
                "old_P": self.covariance - outer_lower(cross * inverse, cross),
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

    def revise(self, slot: Whole, age: ca.SX) -> None:
        """Correct a prediction with what is late and older."""
        builder, n, m = self.builder, self.replay.delays.n, len(self.rows)
        entries = len(triangle(n))
        builder.local("new_x", n, initial=0.0)
        builder.local("new_P", entries, initial=0.0)
        self._signals("revised")
        builder.assign({"new_x": self.state, "new_P": self.covariance})
        self.set_out()
        x, P = builder.symbol("new_x"), builder.symbol("new_P")
        with builder.loop("q", 0, m) as q:
            older = builder.at("late_flag", q) * (builder.at("late_by", q) - age - HALF)
            with _once(builder, older, "older"):
                inverse, known, shared, _ = self.given_late(q)
                weight = builder.define("late_weight", known * inverse)
                cross = builder.define("late_Pc", self.row("revised_cross", q))
                builder.assign(
                    {
                        "new_x": x + cross * weight,
                        "new_P": P - outer_lower(cross * inverse, cross),
                    }
                )
                with builder.loop("j", 0, m) as j:
                    share = builder.define("late_share", builder.at(shared, j) * inverse)
                    left = self.row("revised_cross", j) - share * cross
                    self.put("revised_cross", j, left)
        builder.assign({"known_state": x, "known_covariance": P, At(WRITTEN, slot): ca.SX(1)})
        self.copy(At(STATE, n * slot), At("new_x", 0), n)
        self.copy(At(COVARIANCE, entries * slot), At("new_P", 0), entries)
        with _once(builder, age - HALF, "kept"):
            for name, size in self.replay.beside.items():
                self.copy(At(name, size * slot), At(name, size * slot), size)

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
        return self.builder.symbol("known_state"), self.builder.symbol("known_covariance")

    def counts(self, row: int) -> ca.SX | None:
        """What is positive where a row that is there is one of this sample."""
        if row not in self.late:
            return None
        return ca.fmin(HALF - self.late[row], self.counted(row))

    def counted(self, row: int) -> ca.SX:
        """What is positive where a row counts, late or not."""
        return self.builder.symbol(f"age_{row}") + HALF

    def tell(self) -> None:
        """Innovations of late rows with the others, about what was known before this sample."""
        builder, plant = self.builder, self.plant
        seen = plant.C @ self.symbols["predicted_state"] + plant.D @ self.symbols["u"] + plant.d
        for row in range(plant.ny):
            with builder.if_present(row, self.counts(row)):
                self._put(row, self.symbols["y"][row] - seen[row])
            if row in self.late:
                with builder.if_positive(self.late[row] - HALF):
                    q = self.rows.index(row)
                    self._put(row, builder.symbol(f"row_{row}") - self.mean[q])
        prior = self.symbols["predicted_covariance"]
        builder.assign({"late_variances": self._covariance(prior)})

    def results(self, found: Conditioned) -> dict[str, ca.SX]:
        """How well late rows fit with the others, and the place of the next sample."""
        place = self.symbols[PLACE]
        return {
            "nis": found.nis + self.nis,
            "log_likelihood": found.log_likelihood + self.log_likelihood,
            PLACE: ca.SX(place < self.replay.samples - 1 - HALF) * (place + 1),
        }

    def replace(self) -> None:
        """Where a row is late, innovations are those about what was known before this sample."""
        builder = self.builder
        with builder.if_positive(self.longest - HALF):
            builder.assign(
                {
                    "innovation": builder.symbol("late_innovation"),
                    "innovation_covariance": builder.symbol("late_variances"),
                }
            )

    def _put(self, row: int, innovation: ca.SX) -> None:
        """The innovation of one row."""
        many = self.plant.ny > 1
        self.builder.assign({At("late_innovation", row) if many else "late_innovation": innovation})

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
