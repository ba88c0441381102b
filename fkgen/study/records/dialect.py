"""How a CSV file is written: found out from its first lines and the names that are looked for."""

from __future__ import annotations

import csv
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass

from fkgen.study.records.headings import counted, positions
from fkgen.study.records.reading import MARKS, SPACES, Reading

CANDIDATES = (",", ";", "\t", "|", SPACES)
_OTHERS = ";\t|"  # in a field they say that another delimiter is meant
HEAD = 1 << 18  # bytes that are looked at
_ROWS, _AFTER, _LOOKED_AT = 100, 20, 200  # rows that may be the header, after it, for decimals
_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")
_THOUSANDS = re.compile(r"[+-]?\d{1,3}(?:,\d{3})+")
_POINT = re.compile(r"[+-]?(?:\d+\.\d*|\.\d+)(?:[eE][+-]?\d+)?")
_MARKS = frozenset(mark.casefold() for mark in MARKS)
_BOMS = (
    (b"\xef\xbb\xbf", "utf-8-sig"),
    (b"\xff\xfe\x00\x00", "utf-32"),
    (b"\x00\x00\xfe\xff", "utf-32"),
    (b"\xff\xfe", "utf-16"),
    (b"\xfe\xff", "utf-16"),
)

Row = tuple[int, list[str]]  # the line in which a row ends, and its fields


@dataclass(frozen=True, slots=True, kw_only=True)
class Dialect:
    """What is needed to read a CSV file."""

    encoding: str
    delimiter: str
    decimal: str
    headings: tuple[str, ...]
    before: int  # Lines before the first sample
    header: int  # Line of the header; 0 where there is none
    units: int  # Line of units below the header; 0 where there is none


def encoding_of(head: bytes) -> str:
    """The encoding by its mark, else UTF-8 if the bytes are, else that of Windows."""
    for mark, name in _BOMS:
        if head.startswith(mark):
            return name
    try:
        head.decode("utf-8")
    except UnicodeDecodeError as error:
        if error.start < len(head) - 4:  # not only the last character, which is cut
            return "cp1252"
    return "utf-8"


def rows_of(lines: Iterable[str], delimiter: str, before: int = 0) -> Iterator[Row]:
    """Rows that are not blank, without blanks around their fields."""
    clean = (line.replace("\0", "") for line in lines)
    if delimiter == SPACES:
        for number, line in enumerate(clean, before + 1):
            if fields := [field.strip('"') for field in line.split()]:
                yield number, fields
        return
    reader = csv.reader(clean, delimiter=delimiter, skipinitialspace=delimiter != "\t")
    for row in reader:
        fields = [field.strip() for field in row]
        if len(fields) > 1 or any(fields):
            yield before + reader.line_num, fields


def sniff(text: str, encoding: str, reading: Reading, names: Collection[str]) -> Dialect | None:
    """The dialect in which most of the names are headings; None where there are no rows.

    Without names the header is the first row of words with rows of the same width below it.
    """
    lines = re.split(r"\r\n|\n|\r", text)
    skipped = reading.skip_rows or 0
    stated = re.fullmatch(
        r"sep=([^\w\"\0-\x08\n-\x1f\x7f-\U0010ffff])",
        lines[skipped].strip() if len(lines) > skipped else "",
    )
    given = reading.delimiter or (stated[1] if stated else None)
    skipped += bool(stated)
    best: tuple[tuple[int, ...], str, int, list[Row]] | None = None
    for delimiter in (given,) if given else CANDIDATES:
        try:
            rows = list(_first(rows_of(lines[skipped:], delimiter, skipped), _ROWS + _LOOKED_AT))
        except csv.Error:
            continue
        for at in range(min(len(rows), _ROWS)):
            found, words, same, pure, *width = _score(rows, at, names)
            score = found, words, same, pure, int(delimiter != SPACES), *width
            if best is None or score > best[0]:
                best = score, delimiter, at, rows
    if best is None:
        return None
    header = best[0][0] > 0 or not all(map(is_value, best[3][best[2]][1]))
    return _dialect(best[1:], encoding, reading, names, header=header)


def _dialect(
    found: tuple[str, int, list[Row]],
    encoding: str,
    reading: Reading,
    names: Collection[str],
    *,
    header: bool,
) -> Dialect:
    delimiter, at, rows = found
    line, fields = rows[at]
    headings, rest = _headings(fields), rows[at + 1 :]
    if not header:
        headings, rest, line = [str(i + 1) for i in range(len(fields))], rows[at:], 0
    before = line or rest[0][0] - 1
    units = 0
    if line and len(rest) > 1 and _are_units(rest[0][1], rest[1][1]):
        units = before = rest[0][0]
        rest = rest[1:]
    if rest and all(len(f) == len(headings) + 1 and not f[-1] for _, f in rest[:_AFTER]):
        headings = [*headings, ""]
    named = {i for name in names for i in positions(headings, name)}
    decimal = _decimal(rest, delimiter, named) or _decimal(rest, delimiter, range(len(headings)))
    return Dialect(
        encoding=encoding,
        delimiter=delimiter,
        decimal=reading.decimal or decimal or ".",
        headings=tuple(headings),
        before=before,
        header=line,
        units=units,
    )


def is_value(text: str) -> bool:
    """Whether a field is a number, with a point or a comma, or a mark of a missing one."""
    try:
        float(text.replace(",", ".", 1))
    except ValueError:
        return text.casefold() in _MARKS
    return True


def _score(rows: Sequence[Row], at: int, names: Collection[str]) -> tuple[int, ...]:
    fields = _headings(rows[at][1])
    following = [row for _, row in rows[at + 1 : at + 1 + _AFTER]]
    if len(fields) > 1:
        same = sum(abs(len(row) - len(fields)) <= 1 for row in following)
    else:
        same = sum(len(row) == 1 and is_value(row[0]) for row in following)
    found = 0 if all(map(is_value, fields)) else counted(fields, names)
    words = not any(map(is_value, filter(None, fields))) and (
        len(fields) > 1 or found > 0 or same > 0
    )
    pure = not any(
        mark in field for row in (fields, *following) for field in row for mark in _OTHERS
    )
    return found, int(words), min(same, 1), int(pure), len(fields), same


def _headings(fields: Sequence[str]) -> list[str]:
    """Fields of a header; a mark of a comment before them is none of them."""
    first = fields[0].lstrip("#%").strip() if fields else ""
    if not first and len(fields) > 1 and fields[0]:  # "# t gps speed", at blanks
        return list(fields[1:])
    return [first, *fields[1:]]


def _are_units(fields: Sequence[str], below: Sequence[str]) -> bool:
    """Whether a row is words alone above a row with numbers."""
    words = [field for field in fields if field and field.casefold() not in _MARKS]
    return bool(words) and not any(map(is_value, words)) and any(map(_is_number, below))


def _is_number(text: str) -> bool:
    return is_value(text) and text.casefold() not in _MARKS


def _decimal(rows: Sequence[Row], delimiter: str, columns: Collection[int]) -> str:
    """A comma where numbers have one and none has a point; 1,234 in quotes may be a thousand.

    Nothing where no number has either.
    """
    fields = [f for _, row in rows[:_LOOKED_AT] for i, f in enumerate(row) if i in columns]
    commas = [field for field in fields if _COMMA.fullmatch(field)]
    if any(map(_POINT.fullmatch, fields)):
        return "."
    if not commas:
        return ""
    thousands = delimiter == "," and all(map(_THOUSANDS.fullmatch, commas))
    return "." if thousands else ","


def _first(rows: Iterable[Row], count: int) -> Iterator[Row]:
    for row, _ in zip(rows, range(count), strict=False):
        yield row
