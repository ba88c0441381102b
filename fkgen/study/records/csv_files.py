"""CSV files of any dialect, read in pieces: by Arrow, and row by row where Arrow gives up.

The slow way is the one that knows lines: what Arrow refuses is read again there, which either
finds a number after all or says where there is none.
"""

from __future__ import annotations

import codecs
import csv
import io
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import compute as arrow
from pyarrow import csv as arrow_csv

from fkgen.errors import DataError
from fkgen.study.records.dialect import HEAD, Dialect, encoding_of, rows_of, sniff
from fkgen.study.records.headings import counted
from fkgen.study.records.reading import MARKS, SPACES, Reading, as_numpy

BLOCK = 1 << 20  # bytes that Arrow reads at a time
_ROWS = 50_000  # of a piece that is read row by row
_SHOWN = 40  # characters of a field in an error
_ENDLESS = 1 << 30  # characters of a field: Python's limit would stop at a quote that is not closed

Piece = dict[int, Any]  # columns by number: arrays of numbers, or Arrow arrays of texts


class CsvFile:
    """A CSV file whose dialect is known."""

    stamps: tuple[int, ...] = ()  # its times are texts

    def __init__(self, reading: Reading, names: Collection[str]) -> None:
        self.file, self._path, self._reading = str(reading.path), reading.path, reading
        self.dialect = self._sniffed(names)
        self.headings, self.decimal = self.dialect.headings, self.dialect.decimal
        more = {mark.casefold() for mark in reading.missing}
        self._marks = frozenset(mark.casefold() for mark in MARKS) | more
        self.notes: tuple[str, ...] = ()
        if self.dialect.units:
            self.notes = (f"line {self.dialect.units} is taken for units",)

    def pieces(self, columns: Sequence[int], texts: Collection[int]) -> Iterator[Piece]:
        """The columns from the first sample to the last; those of ``texts`` as they are written."""
        done = 0
        try:
            for piece in self._fast(columns, texts):
                done += len(piece[columns[0]])
                yield piece
        except (pa.ArrowInvalid, UnicodeError):
            pass  # at this place: go on row by row
        else:
            return
        yield from self._slow(columns, texts, done)

    def where(self, sample: int) -> str:
        """The place of a sample, for a message."""
        return f"line {next(islice(self._rows(), sample, None))[0]}"

    def text(self, sample: int, column: int) -> str:
        """A field as it is written."""
        return next(islice(self._rows(), sample, None))[1][column]

    def place(self, column: int | None = None, sample: int | None = None) -> str:
        """File, line and column, as far as they are known; without a sample the header."""
        line = f", line {max(1, self.dialect.header)}" if sample is None else ""
        line = line if sample is None else f", {self.where(sample)}"
        return f"{self.file}{line}{'' if column is None else f', column {self.headings[column]}'}"

    def _fast(self, columns: Sequence[int], texts: Collection[int]) -> Iterator[Piece]:
        names = [f"c{i}" for i in range(len(self.headings))]
        kinds = {f"c{i}": pa.string() if i in texts else pa.float64() for i in columns}
        marks = [*MARKS, *(mark.lower() for mark in MARKS), *(mark.upper() for mark in MARKS)]
        marks += [*map(str.capitalize, MARKS), "NaN", *self._reading.missing]
        blanks = [
            f"{before}{mark}{after}"
            for mark in marks
            for before in ("", " ")
            for after in ("", " ")
        ]
        with self._decoded() as text:
            reader = arrow_csv.open_csv(
                _Bytes(text, self.dialect.delimiter),
                read_options=arrow_csv.ReadOptions(column_names=names, block_size=BLOCK),
                parse_options=arrow_csv.ParseOptions(
                    delimiter=self.dialect.delimiter, newlines_in_values=True
                ),
                convert_options=arrow_csv.ConvertOptions(
                    column_types=kinds,
                    include_columns=[f"c{i}" for i in columns],
                    null_values=[*blanks, *(" " * width for width in range(9))],
                    strings_can_be_null=True,
                    decimal_point=self.dialect.decimal,
                ),
            )
            for batch in reader:
                yield {i: _column(batch.column(at), i in texts) for at, i in enumerate(columns)}

    def _slow(self, columns: Sequence[int], texts: Collection[int], done: int) -> Iterator[Piece]:
        rows = islice(self._rows(), done, None)
        while part := list(islice(rows, _ROWS)):
            piece: Piece = {}
            for column in columns:
                if column in texts:
                    fields = [row[column] for _, row in part]
                    whole = [None if f.casefold() in self._marks else f for f in fields]
                    piece[column] = pa.array(whole, pa.string())
                else:
                    piece[column] = np.array([self._value(row, column) for row in part])
            yield piece
            done += len(part)

    def _value(self, row: tuple[int, list[str]], column: int) -> float:
        """A number; NaN where a field is empty or says so."""
        line, fields = row
        text = fields[column]
        if text.casefold() in self._marks:
            return np.nan
        point = text.replace(self.dialect.decimal, ".") if "." not in text else text
        try:
            if "_" in text or (self.dialect.decimal == "," and "." in text):
                raise ValueError  # 1_0 is a number in Python only  # noqa: TRY301
            return float(point)
        except ValueError:
            shown = text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."
            hint = "; --missing, --decimal and --delimiter say how others are written"
            raise DataError(
                f"{self.file}, line {line}, column {self.headings[column]}",
                given=repr(shown),
                expected=f"a number such as -1.5e3, or nothing where the sample is missing{hint}",
            ) from None

    def _rows(self) -> Iterator[tuple[int, list[str]]]:
        """Rows of as many fields as the header has, with the lines in which they end."""
        width = len(self.headings)
        csv.field_size_limit(_ENDLESS)
        with self._decoded() as lines:
            rows = rows_of(lines, self.dialect.delimiter, self.dialect.before)
            for line, fields in rows:
                if len(fields) > width and not any(fields[width:]):
                    del fields[width:]
                if len(fields) != width:
                    given, expected = f"{len(fields)} fields", f"{width}, as in the header"
                    if any("\n" in field for field in fields):
                        given += ", one of them over several lines: a quote that is not closed"
                    raise DataError(f"{self.file}, line {line}", given=given, expected=expected)
                yield line, fields

    @contextmanager
    def _decoded(self) -> Iterator[io.TextIOBase]:
        """The text from the first sample on."""
        with self._opened(self._path, self.dialect.encoding) as file:
            for _ in range(self.dialect.before):
                file.readline()
            yield file

    def _opened(self, path: Path, encoding: str) -> io.TextIOWrapper:
        try:
            return path.open(encoding=encoding, errors="replace", newline=None)
        except (OSError, ValueError) as error:
            reason = str(getattr(error, "strerror", None) or error).lower()
            given = f"a path that cannot be read ({reason})"
            raise DataError(self.file, given=given, expected="a record file") from None

    def _sniffed(self, names: Collection[str]) -> Dialect:
        encoding = self._reading.encoding
        with self._opened(self._path, "latin-1") as file:
            head = bytes(file.buffer.read(HEAD))
        if encoding is None or codecs.lookup(encoding).name == "utf-8":
            encoding = encoding_of(head) if encoding is None else "utf-8-sig"
        decoder = codecs.getincrementaldecoder(encoding)("replace")
        try:
            text = decoder.decode(head)
        except UnicodeError as error:
            given = f"a file that is not in {encoding} ({error})"
            expected = "its encoding as --encoding, or none: most are found out"
            raise DataError(self.file, given=given, expected=expected) from None
        if len(head) == HEAD:
            text = text[: max(text.rfind("\n"), text.rfind("\r")) + 1] or text
        found = sniff(text, encoding, self._reading, names)
        if found is None:
            expected = "a header with names of columns, then numbers"
            raise DataError(f"{self.file}, line 1", given="an empty file", expected=expected)
        if not found.header and not counted(found.headings, names):
            given, expected = "numbers and no header", "a header, or --column NAME=1 and so on"
            raise DataError(f"{self.file}, line 1", given=given, expected=expected)
        return found


class _Bytes(io.RawIOBase):
    """The bytes in UTF-8 of a text, without the zeros that a loss of power leaves in a file."""

    def __init__(self, text: io.TextIOBase, delimiter: str) -> None:
        self._text, self._blanks, self._rest = text, delimiter == SPACES, b""

    def readable(self) -> bool:
        return True

    def read(self, size: int = -1) -> bytes:
        while not self._rest:
            part = "".join(self._text.readlines(size)) if self._blanks else self._text.read(size)
            if not part:
                break
            part = part.replace("\0", "")
            if self._blanks:  # one between fields, none before the first and after the last
                part = "".join(f"{' '.join(line.split())}\n" for line in part.split("\n"))
            self._rest = part.encode("utf-8", "replace")
        end = size if size >= 0 else len(self._rest)
        found, self._rest = self._rest[:end], self._rest[end:]
        return found


def _column(column: pa.Array, is_text: bool) -> Any:  # noqa: FBT001 - the kind of a column
    if is_text:
        return arrow.utf8_trim_whitespace(column)
    return as_numpy(column)
