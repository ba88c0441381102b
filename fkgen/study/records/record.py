"""A record file opened for a spec: its samples in pieces, and the time from each to the next."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError
from fkgen.problem import Spec
from fkgen.runtime.record import choice
from fkgen.study.records.headings import column_of, listed, parted, time_column
from fkgen.study.records.reading import Reading

if TYPE_CHECKING:
    from fkgen.study.records.clock import Times

Array = NDArray[np.float64]

_AGREE = 1e-6  # relative difference of an interval and a column that states it
_DOUBTFUL = (-9999.0, -99999.0, -999999.0)  # what many a logger writes where there is no value
_UNEVEN = 0.5  # of a fixed sample time: an interval may be off by that
_NEAR = 1000.0  # a value that close to it makes it a number as any other
_COARSE = 0.05  # of an interval: a last decimal above it is no reason for a difference


@dataclass(frozen=True, eq=False, kw_only=True)
class Table:
    """A record of T samples, or a piece of one."""

    file: str
    time_name: str = ""  # of the time column; empty if there is none
    time_text: Any = ()  # the times as they stand in the file, an Arrow array
    time_label: str = ""  # of an axis of the times
    time: Array  # (T,), in seconds, or the sample numbers if there are none
    y: Array  # (T, p), measurements; NaN = missing
    u: Array  # (T, q), inputs
    params: dict[str, Array] = field(default_factory=dict)  # (T,) each, those that are known
    notes: tuple[str, ...] = ()  # what was ignored or taken for granted
    warnings: tuple[str, ...] = ()  # what contradicts itself
    where: Callable[[int], str] = "row {}".format  # the place of a sample, such as "line 7"

    @property
    def samples(self) -> int:
        """Number of samples, T."""
        return len(self.y)


def opened(reading: Reading, names: Sequence[str]) -> Any:
    """The file of a record: columns with headings, in pieces."""
    from fkgen.study.records.binary_files import binary_file  # noqa: PLC0415 - slow to import
    from fkgen.study.records.csv_files import CsvFile  # noqa: PLC0415

    looked_for = [reading.columns.get(name, name) for name in names]
    return binary_file(reading) or CsvFile(reading, looked_for)


def clock_of(spec: Spec) -> str:
    """The parameter that the time from sample to sample is the value of; empty if none is.

    It is the one that ``model.sample_time`` names; where that says nothing, one that is called dt.
    """
    stated = spec.model.sample_time
    if isinstance(stated, str):
        return stated
    return "dt" if stated is None and "dt" in spec.defaults else ""


@dataclass(frozen=True, eq=False)
class _Piece:
    table: Table
    times: Times | None
    start: int  # Samples before it


class Record:
    """A record file and a spec. Notes and warnings are complete after the last piece.

    Parameters ``without`` a value are not looked for.
    """

    def __init__(self, reading: Reading, spec: Spec, without: Collection[str] = ()) -> None:
        self._spec, self._reading = spec, _renamed(reading, spec)
        self._parameters = [name for name in spec.defaults if name not in without]
        self._outputs = [signal.name for signal in spec.model.outputs]
        self._inputs = [signal.name for signal in spec.model.inputs]
        self._clock = clock_of(spec)
        wanted = [*self._outputs, *self._inputs]
        self.source = opened(self._reading, wanted)
        try:
            self._columns = self._found(wanted, self._parameters)
            self._time, self._unit = time_column(
                self.source.headings,
                self._reading.time,
                self._columns.values(),
                self.source.stamps,
            )
        except DataError as error:
            what = self.source.place() + (f": {error.what}" if error.what else "")
            raise DataError(what, given=error.given, expected=error.expected) from None
        self._said, self._warned = list(self._first_notes()), list[str]()
        self._label, self._origin, self._interval = "", 0.0, np.nan
        self._fixed = spec.model.sample_time if isinstance(spec.model.sample_time, float) else None

    @property
    def time_name(self) -> str:
        """Heading of the time column, or nothing."""
        return "" if self._time is None else str(self.source.headings[self._time])

    @property
    def notes(self) -> tuple[str, ...]:
        """What was ignored or taken for granted."""
        return tuple(f"{self.source.file}: {note}" for note in (*self.source.notes, *self._said))

    @property
    def warnings(self) -> tuple[str, ...]:
        """What contradicts itself."""
        return tuple(self._warned)

    def pieces(self) -> Iterator[Table]:
        """The samples in order; every sample knows the time to the one after it."""
        waiting: _Piece | None = None
        done, texts = 0, () if self._time is None else (self._time,)
        for columns in self.source.pieces((*{*self._columns.values(), *texts},), texts):
            if not len(columns[self._columns[self._outputs[0]]]):
                continue
            piece = self._piece(columns, done)
            if waiting is not None:
                yield self._timed(waiting, piece)
            waiting = piece
            done += piece.table.samples
        if waiting is None:
            raise nothing_below(self.source)
        yield self._timed(waiting, None)

    def _found(self, wanted: list[str], known: list[str]) -> dict[str, int]:
        """The columns of signals, which have to be there, and of parameters."""
        headings, renamed = self.source.headings, self._reading.columns
        found = {name: column_of(headings, name, renamed) for name in dict.fromkeys(wanted + known)}
        missing = [name for name in wanted if found[name] is None]
        if missing:
            given = f"no column {', '.join(missing)} (there are: {listed(headings)})"
            expected = f"a column for each of: {', '.join(wanted)}"
            raise DataError("", given=given, expected=expected)
        return {name: column for name, column in found.items() if column is not None}

    def _first_notes(self) -> Iterator[str]:
        headings, clock = self.source.headings, self._clock
        for name in self._parameters:
            if name in self._columns:
                continue
            if name == clock and self._time is not None:
                yield f"{name} is the time from sample to sample, of column {self.time_name!r}"
            else:
                times = " and no time column" if name == clock else ""
                yield f"default of parameter {name}: no such column{times}"
        used = {*self._columns.values(), self._time}
        extra = [repr(h) for i, h in enumerate(headings) if h and i not in used]
        if extra:
            yield f"ignored: {listed(extra)}"
        for signal in (*self._spec.model.outputs, *self._spec.model.inputs):
            heading = headings[self._columns[signal.name]]
            unit = parted(heading)[1]
            if unit and signal.unit and _plain(unit) != _plain(signal.unit):
                yield f"column {heading!r} is taken as it stands, in {signal.unit}"

    def _piece(self, columns: dict[int, Any], start: int) -> _Piece:
        """Signals and parameters of a piece; the clock may still have gaps."""
        values = {
            name: without_marks(self.source, self._reading, columns[column], column, start)
            for name, column in self._columns.items()
        }
        for name, each in values.items():
            if name not in self._outputs and name != self._clock:
                role = "an input" if name in self._inputs else "a parameter"
                refuse_missing(self.source, each, self._columns[name], start, role)
        samples = len(values[self._outputs[0]])
        driven = [values[name] for name in self._inputs]
        table = Table(
            file=self.source.file,
            time_name=self.time_name,
            time=np.arange(start, start + samples, dtype=float),
            y=np.stack([values[name] for name in self._outputs], axis=1),
            u=np.stack(driven, axis=1) if driven else np.zeros((samples, 0)),
            params={name: values[name] for name in self._spec.defaults if name in values},
            where=self.source.where,
        )
        times = self._times(columns, start)
        if times is None:
            return _Piece(table, None, start)
        seconds, label = times.seconds - self._origin, self._label
        table = replace(table, time=seconds, time_label=label, time_text=times.texts)
        return _Piece(table, times, start)

    def _times(self, columns: dict[int, Any], start: int) -> Times | None:
        """The times of a piece, which increase; the first piece says what they are taken for."""
        if self._time is None:
            return None
        from fkgen.study.records.clock import Unreadable, read_times  # noqa: PLC0415 - slow

        try:
            times = read_times(columns[self._time], self._unit, self.source.decimal)
        except Unreadable as error:
            expected = "a time: seconds, an epoch in s, ms, us or ns, or ISO 8601"
            where = self.source.place(self._time, start + error.index)
            raise DataError(where, given=error.given, expected=expected) from None
        if start == 0 and times.kind:
            self._origin, self._label = times.first, f"time since {times.texts[0]} (s)"
            if self._time not in self.source.stamps:
                self._said.append(f"column {self.time_name!r} is taken for {times.kind}")
        elif start == 0:
            self._label = self.time_name if self._unit is None else "time (s)"
        self._compare(times, start)
        wrong = np.flatnonzero(~(times.intervals > 0.0))
        if wrong.size:
            at = int(wrong[0]) + 1
            raise self._backwards(times.texts[at - 1], times.texts[at], start + at)
        return times

    def _compare(self, times: Times, start: int) -> None:
        """Warn of the first interval that is not the sample time of a model that has one."""
        if self._fixed is None or self._warned:
            return
        off = np.abs(times.intervals - self._fixed) > _UNEVEN * self._fixed + times.resolution
        if off.any():
            k = int(np.argmax(off))
            where = self.source.place(self._time, start + k)
            self._warned.append(
                f"{where}: {times.intervals[k]:.6g} s to the next sample; model.sample_time is "
                f"{self._fixed:.6g} s, and used (a parameter there takes the times as they are)"
            )

    def _backwards(self, before: object, after: object, sample: int) -> DataError:
        expected = "times that increase; --time '' goes without them"
        where = self.source.place(self._time, sample)
        return DataError(where, given=f"{after} after {before}", expected=expected)

    def _timed(self, piece: _Piece, after: _Piece | None) -> Table:
        """The piece with the time to the next sample as the value of the clock."""
        table, steps = piece.table, self._steps(piece, after)
        stated = table.params.get(self._clock)
        if not self._clock or (steps is None and stated is None):
            return table
        steps = np.array(stated if steps is None else steps)
        if after is None and np.isnan(steps[-1]):  # there is no next sample
            steps[-1] = steps[-2] if len(steps) > 1 else self._interval
        self._interval = float(steps[-1])
        if stated is not None and piece.times is not None:
            steps = self._agreed(stated, steps, piece, last=after is None)
        params = {name: each for name, each in table.params.items() if name != self._clock}
        if len(steps) == 1 and after is None and np.isnan(steps[0]):
            return replace(table, params=params)  # one sample: the default
        if stated is not None:
            column = self._columns[self._clock]
            refuse_missing(self.source, steps, column, piece.start, "a parameter")
        return replace(table, params={**params, self._clock: steps})

    def _steps(self, piece: _Piece, after: _Piece | None) -> Array | None:
        """From every time to the next; NaN where there is none."""
        times, ending = piece.times, np.nan
        if times is None:
            return None
        if after is not None and after.times is not None:
            ending = times.interval_to(after.times)
            if not ending > 0.0:
                raise self._backwards(times.texts[-1], after.times.texts[0], after.start)
        return np.append(times.intervals, ending)

    def _agreed(self, stated: Array, steps: Array, piece: _Piece, *, last: bool) -> Array:
        """What a column says of the intervals, as far as the times do not contradict it."""
        coarse = 0.0 if piece.times is None else piece.times.resolution
        allowed = _AGREE * np.abs(steps) + np.where(coarse <= _COARSE * steps, coarse, 0.0)
        there = np.isfinite(stated)
        wrong = there & np.isfinite(steps) & ~(np.abs(stated - steps) <= allowed)
        wrong[-1] &= not last
        if wrong.any() and not self._warned:
            k = int(np.flatnonzero(wrong)[0])
            where = self.source.place(self._columns[self._clock], piece.start + k)
            self._warned.append(
                f"{where}: {stated[k]:.9g} contradicts the times, which say {steps[k]:.9g} to the "
                "next sample; the times are used"
            )
        return np.where(there & ~wrong, stated, steps)


def without_marks(source: Any, reading: Reading, values: Array, column: int, start: int) -> Array:
    """A piece of a column with NaN for marks that are numbers; an error asks about -9999."""
    for mark in reading.numbers(source.decimal):
        values = np.where(values == mark, np.nan, values)
    if not reading.missing and (k := first_doubtful(values)) is not None:
        given = f"{values[k]:g}"
        expected = f"--missing {given} if it says that there was no value; else --missing ''"
        raise DataError(source.place(column, start + k), given=given, expected=expected)
    return values


def first_doubtful(values: Array) -> int | None:
    """The first -9999 or its like that no value before it comes near."""
    found = np.flatnonzero(np.isin(values, _DOUBTFUL))
    if not found.size:
        return None
    k = int(found[0])
    before = values[:k][np.isfinite(values[:k])]
    near = before.size > 0 and abs(before[-1] - values[k]) < _NEAR
    return None if near else k


def refuse_missing(source: Any, values: Array, column: int, start: int, role: str) -> None:
    """Refuse a piece of a column in which a number is missing or infinite."""
    wrong = np.flatnonzero(~np.isfinite(values))
    if wrong.size:
        at = start + int(wrong[0])
        given = source.text(at, column) or "nothing"
        expected = f"a finite number: {role} is never missing"
        raise DataError(source.place(column, at), given=given, expected=expected)


def nothing_below(source: Any) -> DataError:
    """The error about a file without samples."""
    given, expected = "a header and nothing below it", "at least one sample"
    return DataError(source.file, given=given, expected=expected)


def _renamed(reading: Reading, spec: Spec) -> Reading:
    """The names of columns of the spec, below those of the command."""
    known = [s.name for s in (*spec.model.outputs, *spec.model.inputs)] + list(spec.defaults)
    for name in reading.columns:
        if name not in known:
            raise DataError("--column", given=repr(name), expected=choice(name, known))
    time = spec.record.time if reading.time is None else reading.time
    return replace(reading, columns={**dict(spec.record.columns), **reading.columns}, time=time)


def _plain(unit: str) -> str:
    """A unit as it is compared: m/s² is m/s^2 is m/s2."""
    for written, plain in (("²", "2"), ("³", "3"), ("^", ""), ("*", ""), (" ", "")):
        unit = unit.replace(written, plain)
    return unit.casefold()
