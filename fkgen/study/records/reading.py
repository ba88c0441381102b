"""What a user says about a record file beside its name; what is not said is found out."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError

SPACES = " "  # the delimiter that is any number of blanks and tabs
_DELIMITERS = {"tab": "\t", "\\t": "\t", "comma": ",", "semicolon": ";", "space": SPACES}
_FEWEST = {"spaces": SPACES, "whitespace": SPACES, "blank": SPACES, "pipe": "|"}
#: Written where there was no value, by loggers, spreadsheets and printf; in any case.
MARKS = (
    *("", "NA", "N/A", "#N/A", "<NA>", "NULL", "None", "-", "--", "---"),
    *("nan", "-nan", "nan(ind)", "-nan(ind)", "nan(snan)", "-nan(snan)"),
    *("1.#QNAN", "-1.#QNAN", "1.#IND", "-1.#IND", "1.#SNAN", "-1.#SNAN"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """A record file and how to read it; None is found out."""

    path: Path
    delimiter: str | None = None
    decimal: str | None = None
    encoding: str | None = None
    skip_rows: int | None = None  # Lines before the header
    missing: tuple[str, ...] = ()  # More marks of missing values
    columns: Mapping[str, str] = field(default_factory=dict)  # Signal or parameter, and heading
    time: str | None = None  # Heading of the time column; empty: there is none

    def numbers(self, decimal: str) -> tuple[float, ...]:
        """Marks of missing values that are compared as numbers, in a file of this decimal mark."""
        found = (_number(mark.replace(decimal, ".")) for mark in self.missing)
        return tuple(each for each in found if each is not None)


def reading_of(path: str | os.PathLike[str] | Reading) -> Reading:
    """A path is read without any options."""
    return path if isinstance(path, Reading) else Reading(path=Path(path))


def as_numpy(column: Any) -> NDArray[Any]:
    """The numbers of an Arrow array; of doubles a null is NaN. Its own way would import pandas."""
    filled = column.fill_null(_arrow(np.array([np.nan]))[0]) if column.null_count else column
    return np.from_dlpack(filled)


def as_arrow(values: NDArray[Any]) -> Any:
    """Numbers as an Arrow array, NaN as null. Its own way would import pandas."""
    from pyarrow import compute, nulls  # noqa: PLC0415 - slow to import

    if values.dtype == np.bool_:
        return _arrow(values.view(np.uint8)).cast("bool")
    found = _arrow(values)
    if not np.isnan(values).any():
        return found
    return compute.if_else(compute.is_nan(found), nulls(1, found.type)[0], found)


def _arrow(values: NDArray[Any]) -> Any:
    import pyarrow as pa  # noqa: PLC0415 - slow to import

    whole = np.ascontiguousarray(values)
    kind = pa.from_numpy_dtype(whole.dtype)
    return pa.Array.from_buffers(kind, len(whole), [None, pa.py_buffer(whole)])


def checked(
    path: Path,
    *,
    columns: tuple[str, ...] = (),
    delimiter: str | None = None,
    decimal: str | None = None,
    skip_rows: int | None = None,
    encoding: str | None = None,
    missing: tuple[str, ...] = (),
    time: str | None = None,
) -> Reading:
    """The options of a command, each refused where it can mean nothing."""
    if delimiter is not None:
        delimiter = (_DELIMITERS | _FEWEST).get(delimiter.lower(), delimiter)
        if (
            len(delimiter) != 1
            or delimiter in '"\r\n'
            or delimiter.isalnum()
            or not delimiter.isascii()
        ):
            expected = "one character, or tab, space, comma, semicolon"
            raise DataError("--delimiter", given=repr(delimiter), expected=expected)
    if decimal not in {None, ".", ","}:
        raise DataError("--decimal", given=repr(decimal), expected="'.' or ','")
    if skip_rows is not None and skip_rows < 0:
        raise DataError("--skip-rows", given=str(skip_rows), expected="a number of lines")
    if encoding is not None:
        try:
            "a".encode(encoding)
        except (LookupError, ValueError):
            expected = "the name of an encoding, such as utf-8, latin-1, utf-16"
            raise DataError("--encoding", given=repr(encoding), expected=expected) from None
    return Reading(
        path=path,
        delimiter=delimiter,
        decimal=decimal,
        encoding=encoding,
        skip_rows=skip_rows,
        missing=missing,
        columns=dict(map(_renamed, columns)),
        time=time,
    )


def _renamed(text: str) -> tuple[str, str]:
    name, equals, heading = text.partition("=")
    if not (name.strip() and equals and heading.strip()):
        expected = "NAME=HEADING, such as gnss='GPS height [m]'"
        raise DataError("--column", given=repr(text), expected=expected)
    return name.strip(), heading.strip().strip("\"'")


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return None if math.isnan(value) else value
