"""Read what commands are given: records and profiles of faults from files, constant inputs."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError
from fkgen.problem import Spec
from fkgen.study.records.headings import column_of, listed
from fkgen.study.records.reading import Reading, reading_of
from fkgen.study.records.record import Record, Table, nothing_below, opened, refuse_missing

Array = NDArray[np.float64]
Source = str | os.PathLike[str] | Reading
Say = Callable[[str, Iterable[str]], None]  # Tell "note" or "warning" in sentences


def read_table(path: Source, spec: Spec, without: Collection[str] = ()) -> Table:
    """Read the whole record that a spec asks for, without some of its parameters."""
    record = Record(reading_of(path), spec, without)
    whole = joined(list(record.pieces()))
    return replace(whole, notes=record.notes, warnings=record.warnings)


def joined(pieces: Sequence[Table]) -> Table:
    """The pieces of a record as one."""
    texts = [str(text) for piece in pieces for text in piece.time_text]
    signals = ("time", "y", "u")
    whole: dict[str, Any] = {n: np.concatenate([getattr(p, n) for p in pieces]) for n in signals}
    params = {n: np.concatenate([p.params[n] for p in pieces]) for n in pieces[0].params}
    return replace(pieces[0], **whole, params=params, time_text=tuple(texts))


def read_columns(path: Source, names: Sequence[str]) -> dict[str, Array]:
    """Columns of finite numbers by name; of them the file has one at least, the others are zero."""
    reading = reading_of(path)
    source = opened(reading, names)
    found = {name: column_of(source.headings, name, reading.columns) for name in names}
    there = {name: column for name, column in found.items() if column is not None}
    if not there:
        given = f"none of the columns (there are: {listed(source.headings)})"
        expected = f"at least one of: {', '.join(names)}"
        raise DataError(source.place(), given=given, expected=expected)
    parts, done = [], 0
    for piece in source.pieces(tuple(there.values()), ()):
        for column in there.values():
            refuse_missing(source, piece[column], column, done, "a fault")
        parts.append(piece)
        done += len(piece[column])
    if not parts:
        raise nothing_below(source)
    zero = np.zeros(done)
    return {
        name: np.concatenate([part[there[name]] for part in parts]) if name in there else zero
        for name in names
    }


def separated(text: str) -> list[str]:
    """Names separated by commas."""
    return [name.strip() for name in text.split(",") if name.strip()]


def numbers_of(option: str, text: str, count: int) -> Array | None:
    """Numbers separated by commas, one per signal; None if the option was left out."""
    if not text.strip():
        return None
    try:
        values = np.array([float(part) for part in text.split(",")])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        one = "a finite number"
        expected = one if count == 1 else f"{count} finite numbers, separated by commas"
        raise DataError(option, given=repr(text), expected=expected)
    return values


def constants_or_record(
    spec: Spec, inputs: str, record: Reading | None, say: Say
) -> tuple[Array | None, Table | None]:
    """Constant inputs (q,) from ``--u``, or the table of ``--record``, or neither; not both.

    What there is to say about the record is said.
    """
    constants = numbers_of("--u", inputs, spec.model.nu)
    if record is None:
        return constants, None
    if constants is not None:
        raise DataError("--u", given="inputs beside --record", expected="one of the two")
    table = read_table(record, spec)
    say("note", table.notes)
    say("warning", table.warnings)
    return None, table


def profile_of(spec: Spec, path: Path) -> tuple[Array, Array | None]:
    """What is added to y (T, p) and to u (T, q), from a file that names one signal at least."""
    p = spec.model.ny
    names = [signal.name for signal in (*spec.model.outputs, *spec.model.inputs)]
    both = np.stack(list(read_columns(path, names).values()), axis=1)
    return both[:, :p], both[:, p:] if spec.model.nu else None
