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
from fkgen.study.records.headings import parted, time_column
from fkgen.study.records.reading import Reading
from fkgen.study.records.record import opened

Array = NDArray[np.float64]

_COUNTERS = {"", "index", "id", "k", "n", "no", "nr", "sample", "count", "counter", "row"}
_COMMANDS = re.compile(
    r"u\d*|.*(command|cmd|input|voltage|throttle|torque|force|pwm).*", re.IGNORECASE
)
_EVEN = 1e-3  # relative spread of the intervals up to which the clock is even
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
    at, unit = time_column(source.headings, reading.time, ())
    columns = list(_columns(source, at))
    driving = _driving(columns, inputs)
    outputs = [each for each in columns if each not in driving]
    if not outputs:
        expected = "a column of numbers besides the times and the inputs"
        raise DataError(source.place(), given="none", expected=expected)
    clock = None if at is None else _clock(source, at, unit)
    name = _identifier(reading.path.stem, "record", set(), PREFIX)
    heading = "" if at is None else source.headings[at]
    stated = heading if reading.time and reading.time == heading else ""
    lines = _lines(name, outputs, driving, clock, stated)
    return "\n".join([f"# A first guess from {reading.path.name}; read the comments.", *lines, ""])


def _columns(source: Any, time: int | None) -> Iterator[_Column]:
    """The columns of numbers: as much of them as the first piece of the file holds."""
    taken: set[str] = {"dt"}
    for i, heading in enumerate(source.headings):
        name, unit = parted(heading)
        if i == time or name.casefold() in _COUNTERS:
            continue
        with suppress(DataError, StopIteration):
            values = np.asarray(next(source.pieces((i,), ()))[i], float)
            if not np.isfinite(values).any():
                continue
            plain = _identifier(name, f"y{i}", taken)
            taken.add(plain.casefold())
            kept = unit if unit.isprintable() and len(unit) <= MAX_UNIT else ""
            yield _Column(plain, heading, kept, values, *_levels(values))


def _levels(values: Array) -> tuple[float, float]:
    """Variances of the steps of a random walk and of white noise on it, by their moments.

    Of the differences d of such a signal Var(d) = q + 2 r and Cov(d[k], d[k+1]) = -r.
    """
    there = np.flatnonzero(np.isfinite(values))
    steps = np.diff(values[there])
    spread = float(np.var(values[there])) or 1.0
    least = _SMALL * spread
    if len(steps) < 3:
        return least, max(0.01 * spread, least)
    steps = steps - steps.mean()
    both = float(np.mean(steps * steps))
    noise = -float(np.mean(steps[1:] * steps[:-1]))
    noise = min(max(noise, 0.01 * both, least), 0.5 * both) if both else least
    spacing = (there[-1] - there[0]) / (len(there) - 1)
    return max((both - 2.0 * noise) / spacing, least), noise


def _driving(columns: Sequence[_Column], inputs: str) -> list[_Column]:
    """Columns that are inputs: those that are stated, or that are called so and miss nothing."""
    names = [name.strip() for name in inputs.split(",") if name.strip()]
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
    time: str,
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
    yield "# a random walk in white noise: R = -Cov(d[k], d[k+1]), Q = Var(d) - 2 R."
    if clock is not None and varies:
        steps = [f'"{_digits(each.level / clock[0])}*dt"' for each in outputs]
    else:
        steps = [_digits(each.level) for each in outputs]
    yield f"Q = {_diagonal(steps)}"
    yield f"R = {_diagonal([_digits(each.noise) for each in outputs])}"
    yield f"x0 = [{', '.join(_digits(_first(each)) for each in outputs)}]  # the first values"
    wide = [_digits(100.0 * max(each.noise, each.level)) for each in outputs]
    yield f"P0 = {_diagonal(wide)}  # vague: 100 times the noise"
    yield '\n[filter]\nfamily = "kf"  # see: fkgen families'
    renamed = [
        c for c in (*outputs, *inputs) if parted(c.heading)[0].casefold() != c.name.casefold()
    ]
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
