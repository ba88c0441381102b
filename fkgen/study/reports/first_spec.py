"""A spec to begin with, from a record: its signals, its sample time, a guess of the noises."""

from __future__ import annotations

import json
import math
import re
import unicodedata
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError, SpecError
from fkgen.problem.signals import MAX_LENGTH, MAX_UNIT, PREFIX, parameter_words, read_name
from fkgen.problem.table.place import Place
from fkgen.runtime.record import choice
from fkgen.study.records.headings import listed, parted, time_column, unit_of
from fkgen.study.records.reading import Reading
from fkgen.study.records.record import opened, without_marks
from fkgen.study.records.table import separated

Array = NDArray[np.float64]

_COUNTERS = {"", "index", "id", "k", "n", "no", "nr", "sample", "count", "counter", "row"}
_COMMANDS = re.compile(
    r"u\d*|.*(command|cmd|input|voltage|throttle|torque|force|pwm).*", re.IGNORECASE
)
_CLOCKS = re.compile(r".*(time|zeit|stamp|date|datum|clock|epoch|tout|temps).*", re.IGNORECASE)
_EVEN = 1e-3  # relative spread of the intervals up to which the clock is even
_DIFFERENCES = 8  # lengths of a lag in a record from which its variance is taken
_RISING = 10  # steps of a first column without a telling name that make it one of times
_SMALL = 1e-9  # of the variance of a signal: noise levels are not below it


@dataclass(frozen=True, slots=True)
class _Column:
    name: str  # an identifier
    heading: str
    unit: str
    values: Array
    level: float  # variance of the steps of the level, per sample
    noise: float  # variance of the measurement noise


def first_spec(reading: Reading, inputs: str = "") -> str:
    """The text of a spec of a random walk per output, which loads and runs on the record."""
    source = opened(replace(reading, columns={}), ())
    at, unit = time_column(source.headings, reading.time, (), source.stamps)
    stated = bool(reading.time)
    if at is None and reading.time is None:
        at = next((i for i, _ in enumerate(source.headings) if _is_clock(source, i)), None)
        unit, stated = (None, False) if at is None else (unit_of(source.headings[at]), True)
    columns = list(_columns(source, reading, at))
    driving = _driving(columns, inputs)
    outputs = [each for each in columns if each not in driving]
    if not outputs:
        expected = "a column of numbers besides the times and the inputs"
        raise DataError(source.place(), given="none", expected=expected)
    clock = None if at is None else _clock(source, at, unit)
    name = _identifier(reading.path.stem, "record", set(), PREFIX)
    lines = list(_lines(name, outputs, driving, clock))
    known = {each.heading for each in columns}
    out = [h for i, h in enumerate(source.headings) if h and i != at and h not in known]
    first = [f"# A first guess from {reading.path.name}; read the comments."]
    if out:
        first.append(
            f"# Left out, as no columns of numbers or as counters: {listed(list(map(repr, out)))}"
        )
    lines += _record_lines(
        (*outputs, *driving), source.headings[at] if stated and at is not None else ""
    )
    return "\n".join([*first, *lines, ""])


def _is_clock(source: Any, column: int) -> bool:
    """Whether a column is one of times: dates, or numbers that rise and are the first or called so.

    Of numbers in the first column only even steps are taken for times.
    """
    from fkgen.study.records.clock import Unreadable, read_times  # noqa: PLC0415 - slow

    name = parted(source.headings[column])[0]
    try:
        written = next(source.pieces((column,), (column,)))[column]
        if len(written) < 2:
            return False
        times = read_times(written, None, source.decimal)
    except (Unreadable, DataError, StopIteration):
        return False
    steps = times.intervals
    if not (steps > 0.0).all():
        return False
    if times.kind or _CLOCKS.fullmatch(name):
        return True
    even = np.ptp(steps) <= _EVEN * steps[0] + times.resolution
    return column == 0 and len(steps) >= _RISING and bool(even) and name.casefold() not in _COUNTERS


def _columns(source: Any, reading: Reading, time: int | None) -> Iterator[_Column]:
    """The columns of numbers: as much of them as the first piece of the file holds."""
    taken: set[str] = {"dt"}
    for i, heading in enumerate(source.headings):
        name, unit = parted(heading)
        if i == time or name.casefold() in _COUNTERS:
            continue
        try:
            values = np.asarray(next(source.pieces((i,), ()))[i], float)
        except (DataError, StopIteration):  # no numbers
            continue
        values = without_marks(source, reading, values, i, 0)
        if not np.isfinite(values).any():
            continue
        plain = _identifier(name, f"y{i}", taken)
        taken.add(plain.casefold())
        kept = unit if unit.isprintable() and len(unit) <= MAX_UNIT else ""
        yield _Column(plain, heading, kept, values, *_levels(values))


@np.errstate(over="ignore", invalid="ignore")  # of what is not finite there is no guess
def _levels(values: Array) -> tuple[float, float]:
    """Variances of the steps of a random walk and of white noise on it, by their moments.

    Of the differences d of such a signal Var(d) = q + 2 r and Cov(d[k], d[k+1]) = -r. A q below r
    is lost in the scatter of these: then it is that of the differences over m samples, of which
    Var = m q + 2 r, for the m that finds most.
    """
    there = np.flatnonzero(np.isfinite(values))
    heard = values[there]
    spread = float(np.var(heard)) or 1.0
    least = _SMALL * spread
    if len(heard) < 4:
        return least, max(0.01 * spread, least)
    raw = np.diff(heard)
    steps = raw - raw.mean()
    both = _mean_square(steps)
    noise = -float(np.mean(steps[1:] * steps[:-1]))
    noise = min(max(noise, 0.01 * both, least), 0.5 * both) if both else least
    level = _mean_square(raw) - 2.0 * noise  # a trend is to be followed as well
    lags = _lags(len(heard))
    if level < noise and lags:
        level = max((_mean_square(heard[m:] - heard[:-m]) - 2.0 * noise) / m for m in lags)
    spacing = (there[-1] - there[0]) / (len(there) - 1)
    return max(level / spacing, least), noise


def _mean_square(values: Array) -> float:
    return float(np.mean(values * values))


def _lags(samples: int) -> list[int]:
    """Lags over which slow changes are looked for, as many as have enough differences."""
    return [m for m in (8, 16, 32, 64, 128, 256, 512, 1024) if _DIFFERENCES * m <= samples]


def _driving(columns: Sequence[_Column], inputs: str) -> list[_Column]:
    """Columns that are inputs: those that are stated, or that are called so and miss nothing."""
    names = separated(inputs)
    known = [each.name for each in columns]
    for name in names:
        if name not in known:
            raise DataError("--inputs", given=repr(name), expected=choice(name, known))
    if inputs:
        return [each for each in columns if each.name in names]
    return [c for c in columns if _COMMANDS.fullmatch(c.name) and np.isfinite(c.values).all()]


def _clock(source: Any, column: int, unit: Any) -> tuple[float, bool] | None:
    """The usual time from sample to sample, and whether it is always that."""
    from fkgen.study.records.clock import Unreadable, read_times  # noqa: PLC0415 - slow

    try:
        times = read_times(next(source.pieces((column,), (column,)))[column], unit, source.decimal)
    except Unreadable as error:
        expected = "a time: seconds, an epoch in s, ms, us or ns, or ISO 8601"
        where = source.place(column, error.index)
        raise DataError(where, given=error.given, expected=expected) from None
    steps = times.intervals
    usual = float(np.median(steps)) if len(steps) else 0.0
    if not usual > 0.0:
        return None
    allowed = _EVEN * usual + times.resolution
    return usual, bool((np.abs(steps - usual) <= allowed).all())


def _lines(
    name: str,
    outputs: Sequence[_Column],
    inputs: Sequence[_Column],
    clock: tuple[float, bool] | None,
) -> Iterator[str]:
    p, samples = len(outputs), len(outputs[0].values)
    varies = clock is not None and not clock[1]
    yield f"name = {json.dumps(name)}\n"
    if clock is not None and varies:
        yield "[parameters]"
        yield f"dt = {_digits(clock[0])}  # s, the usual interval; a record's times replace it\n"
    yield "[model]"
    if clock is None:
        yield "# sample_time = 0.01  # s; the record has no times"
    elif varies:
        yield 'sample_time = "dt"  # the intervals vary'
    else:
        yield f"sample_time = {_digits(clock[0])}  # s, by the times of the record"
    yield f"outputs = [{', '.join(map(_signal, outputs))}]"
    yield f"states = [{', '.join(map(_signal, outputs))}]  # one level per output"
    if inputs:
        yield f"inputs = [{', '.join(map(_signal, inputs))}]"
    yield f"A = {_diagonal(['1.0'] * p)}"
    if inputs:
        zeros = f"[{', '.join(['0.0'] * len(inputs))}]"
        yield f"B = [{', '.join([zeros] * p)}]  # what the inputs do is not known from the record"
    yield f"C = {_diagonal(['1.0'] * p)}"
    yield f"# First guesses, from the differences d of {samples} samples of each, as if it were"
    yield "# a random walk in white noise: R = -Cov(d[k], d[k+1]), Q = Var(d) - 2 R, or over m"
    yield "# samples, (Var - 2 R)/m, where that is lost in the noise."
    if clock is not None and varies:
        steps = [f'"{_digits(each.level / clock[0])}*dt"' for each in outputs]
    else:
        steps = [_digits(each.level) for each in outputs]
    yield f"Q = {_diagonal(steps)}"
    yield f"R = {_diagonal([_digits(each.noise) for each in outputs])}"
    yield f"x0 = [{', '.join(repr(_first(each)) for each in outputs)}]  # the first values"
    wide = [_digits(100.0 * max(each.noise, each.level)) for each in outputs]
    yield f"P0 = {_diagonal(wide)}  # vague: 100 times the noise"
    yield '\n[filter]\nfamily = "kf"  # see: fkgen families'


def _record_lines(columns: Sequence[_Column], time: str) -> Iterator[str]:
    """What the columns of the record are called, where that does not go without saying."""
    renamed = [c for c in columns if parted(c.heading)[0].casefold() != c.name.casefold()]
    if time:
        yield f"\n[record]\ntime = {json.dumps(time, ensure_ascii=False)}"
    if renamed:
        yield "\n[record.columns]"
        yield from (f"{c.name} = {json.dumps(c.heading, ensure_ascii=False)}" for c in renamed)


def _signal(column: _Column) -> str:
    unit = f", unit = {json.dumps(column.unit, ensure_ascii=False)}" if column.unit else ""
    return f'{{name = "{column.name}"{unit}}}'


def _first(column: _Column) -> float:
    return float(column.values[np.isfinite(column.values)][0])


def _diagonal(entries: Sequence[str]) -> str:
    size = range(len(entries))
    rows = (", ".join(entries[i] if i == j else "0.0" for j in size) for i in size)
    return f"[{', '.join(f'[{row}]' for row in rows)}]"


def _digits(value: float) -> str:
    """Three digits, as TOML wants a number."""
    text = f"{value:.3g}" if math.isfinite(value) else "1.0"
    return text if any(mark in text for mark in ".e") else f"{text}.0"


def _identifier(text: str, other: str, taken: set[str], refused: Any = None) -> str:
    """A name that a spec takes, as near to the text as can be."""
    ascii_only = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
    words = re.sub(r"[^A-Za-z0-9]+", "_", ascii_only).strip("_")[: MAX_LENGTH - 4].strip("_")
    possible = words, f"{words}_y", f"y_{words}", other, f"{other}_y"
    for name in possible:
        with suppress(SpecError):
            if name.casefold() not in taken:
                return read_name(name, Place(), refused or parameter_words("", possible))
    return f"{other}_{len(taken)}"
