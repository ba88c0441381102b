"""Read what commands are given: records and profiles of faults from CSV files, constant inputs."""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError
from fkgen.problem import Spec

Array = NDArray[np.float64]

TIME_NAMES = ("t", "t_s", "time")  # of a time column: the first that is there and no signal
_SHOWN = 40  # characters of a field in an error


@dataclass(frozen=True, eq=False, kw_only=True)
class Table:
    """A record of T samples."""

    file: str
    lines: tuple[int, ...]  # line of the file in which each sample ends
    time_name: str  # of the time column; empty if there is none
    time_text: tuple[str, ...]  # the times as they stand in the file
    time: Array  # (T,), the times as numbers, or the sample numbers if there are none
    y: Array  # (T, p), measurements; NaN = missing
    u: Array  # (T, q), inputs
    params: dict[str, Array]  # (T,) each, the run-time parameters that have a column
    notes: tuple[str, ...]  # what was ignored or taken for granted


def read_table(path: str | os.PathLike[str], spec: Spec) -> Table:
    """Read the record that a spec asks for."""
    reader = _Reader(str(path))
    wanted = [signal.name for signal in (*spec.model.outputs, *spec.model.inputs)]
    known = [parameter.name for parameter in spec.parameters]
    reader.demand(wanted)
    time_name = next((n for n in TIME_NAMES if n in reader.columns and n not in wanted + known), "")
    given = [name for name in known if name in reader.columns]
    extra = [n for n in reader.columns if n not in {*wanted, *known, time_name}]
    notes = [f"default of parameter {n}: no such column" for n in known if n not in given]
    notes += [f"ignored: {', '.join(map(repr, extra))}"] if extra else []
    samples = len(reader.lines)
    time = reader.times(time_name) if time_name else np.arange(samples, dtype=float)
    y = [reader.measured(signal.name) for signal in spec.model.outputs]
    u = [reader.finite(signal.name, "an input") for signal in spec.model.inputs]
    return Table(
        file=str(path),
        lines=tuple(reader.lines),
        time_name=time_name,
        time_text=reader.columns.get(time_name, ()),
        time=time,
        y=np.stack(y, axis=1),
        u=np.stack(u, axis=1) if u else np.zeros((samples, 0)),
        params={name: reader.finite(name, "a parameter") for name in given},
        notes=tuple(f"{path}: {note}" for note in notes),
    )


def read_columns(path: str | os.PathLike[str], names: Sequence[str]) -> dict[str, Array]:
    """Columns of finite numbers by name; of them the file has one at least, the others are zero."""
    reader = _Reader(str(path))
    if not any(name in reader.columns for name in names):
        given = f"none of the columns (there are: {', '.join(reader.columns)})"
        raise reader.error(given, f"at least one of: {', '.join(names)}", line=1)
    zero = np.zeros(len(reader.lines))
    return {n: reader.finite(n, "a fault") if n in reader.columns else zero for n in names}


def numbers_of(option: str, text: str, count: int) -> Array | None:
    """Numbers separated by commas, one per signal; None if the option was left out."""
    if not text.strip():
        return None
    try:
        values = np.array([float(part) for part in text.split(",")])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        expected = f"{count} finite numbers, separated by commas"
        raise DataError(option, given=repr(text), expected=expected)
    return values


def constants_or_record(
    spec: Spec, inputs: str, record: Path | None
) -> tuple[Array | None, Table | None]:
    """Constant inputs (q,) from ``--u``, or the table of ``--record``, or neither; not both."""
    constants = numbers_of("--u", inputs, spec.model.nu)
    if record is None:
        return constants, None
    if constants is not None:
        raise DataError("--u", given="inputs beside --record", expected="one of the two")
    return None, read_table(record, spec)


def profile_of(spec: Spec, path: Path) -> tuple[Array, Array | None]:
    """What is added to y (T, p) and to u (T, q), from a file that names one signal at least."""
    p = spec.model.ny
    names = [signal.name for signal in (*spec.model.outputs, *spec.model.inputs)]
    both = np.stack(list(read_columns(path, names).values()), axis=1)
    return both[:, :p], both[:, p:] if spec.model.nu else None


class _Reader:
    """The fields of one file as text, by columns."""

    def __init__(self, file: str) -> None:
        self.file = file
        header, *rows = self._read() or [(1, [])]
        names = self._header(header[1])
        rows = [(line, row or [""]) for line, row in rows if row or len(names) == 1]
        while len(names) == 1 and rows and rows[-1][1] == [""]:  # blank lines at the end
            rows.pop()
        for line, row in rows:
            if len(row) != len(names):
                expected = f"{len(names)}, as in the header"
                raise self.error(f"{len(row)} fields", expected, line=line)
        if not rows:
            raise self.error("a header and nothing below it", "at least one sample")
        self.lines = [line for line, _ in rows]
        texts = zip(*(row for _, row in rows), strict=True)
        self.columns = {n: column for n, column in zip(names, texts, strict=True) if n}

    def _read(self) -> list[tuple[int, list[str]]]:
        """The rows, stripped of blanks, and the lines in which they end."""
        try:
            with Path(self.file).open(encoding="utf-8-sig", newline="") as file:
                reader = csv.reader(file, strict=True)
                try:
                    return [(reader.line_num, [text.strip() for text in row]) for row in reader]
                except csv.Error as error:
                    expected, line = "fields separated by commas", reader.line_num
                    raise self.error(str(error), expected, line=line) from None
        except UnicodeDecodeError as error:
            raise self.error(f"bytes that are not UTF-8 at {error.start}", "UTF-8 text") from None
        except (OSError, ValueError) as error:
            reason = str(getattr(error, "strerror", None) or error).lower()
            raise self.error(f"a path that cannot be read ({reason})", "a CSV file") from None

    def _header(self, header: list[str]) -> list[str]:
        if not any(header):
            expected = "a header with names of columns, then numbers"
            raise self.error("an empty file", expected, line=1)
        for separator, word in ((";", "semicolons"), ("\t", "tabs")):
            if len(header) == 1 and separator in header[0]:
                raise self.error(f"a header with {word}", "columns separated by commas", line=1)
        twice = [name for name in header if name and header.count(name) > 1]
        if twice:
            raise self.error(f"two columns {twice[0]!r}", "different names", line=1)
        return header

    def demand(self, names: Sequence[str]) -> None:
        """Refuse a file that lacks one of these columns."""
        missing = [name for name in names if name not in self.columns]
        if missing:
            given = f"no column {', '.join(missing)} (there are: {', '.join(self.columns)})"
            raise self.error(given, f"a column for each of: {', '.join(names)}", line=1)

    def measured(self, name: str) -> Array:
        """A column of numbers; NaN where a field is empty or says so."""
        values = np.full(len(self.lines), np.nan)
        for k, text in enumerate(self.columns[name]):
            try:
                values[k] = float(text.replace("_", "?") or "nan")  # 1_0 is a number in Python only
            except ValueError:
                shown = text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."
                expected = "a number such as -1.5e3, or nothing where the sample is missing"
                raise self.error(repr(shown), expected, name, k) from None
        return values

    def finite(self, name: str, role: str) -> Array:
        """A column of which no field may be missing."""
        values = self.measured(name)
        for k in np.flatnonzero(~np.isfinite(values)).tolist():
            given = self.columns[name][k] or "nothing"
            raise self.error(given, f"a finite number: {role} is never missing", name, k)
        return values

    def times(self, name: str) -> Array:
        """The time column: finite, and never running backwards."""
        values, texts = self.finite(name, "a time"), self.columns[name]
        for k in np.flatnonzero(np.diff(values) < 0.0).tolist():
            given = f"{texts[k + 1]} after {texts[k]}"
            raise self.error(given, "times that do not run backwards", name, k + 1)
        return values

    def error(
        self, given: str, expected: str, column: str = "", sample: int = -1, *, line: int = 0
    ) -> DataError:
        """The error that names the place: a line, or a column and a sample."""
        at = self.lines[sample] if column else line
        place = (f", line {at}" if at else "") + (f", column {column}" if column else "")
        return DataError(self.file + place, given=given, expected=expected)
