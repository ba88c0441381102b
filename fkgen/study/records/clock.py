"""Times of a record: numbers with or without a unit, counted from an epoch, ISO 8601, typed.

Differences are taken before anything is rounded: of times in text or whole numbers they are exact.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from fractions import Fraction
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import compute as arrow

from fkgen.study.records.reading import as_numpy

Array = NDArray[np.float64]

_NANO = 10**9
_DIGITS = pa.decimal128(38, 9)
#: Counted from 1970: what a number means by its size, where no unit is stated.
_EPOCHS: tuple[tuple[float, str, int], ...] = (
    (1e11, "", 1),
    (1e14, "epoch milliseconds", 1000),
    (1e17, "epoch microseconds", 10**6),
    (np.inf, "epoch nanoseconds", _NANO),
)
_PER_SECOND = {"s": 1, "ms": 1000, "us": 10**6, "ns": _NANO}


@dataclass(frozen=True, slots=True, eq=False)
class Times:
    """The times of a piece of a record."""

    ticks: NDArray[Any]  # int64, of which differences alone count, or float64
    first: float  # The first of them in seconds
    per_second: Fraction
    texts: Any  # Arrow array of the times as they were written
    kind: str = ""  # What they were taken for, where that is not seconds
    resolution: float = 0.0  # Their last decimal in seconds; 0 where they are not decimal

    @property
    def seconds(self) -> Array:
        """The times as seconds, as well as a double can say them."""
        return self.first + self._scaled(self.ticks - self.ticks[:1])

    @property
    def intervals(self) -> Array:
        """From every time to the next; one less than there are times."""
        return self._scaled(np.diff(self.ticks))

    def interval_to(self, later: Times) -> float:
        """From the last of these times to the first of the later ones."""
        if self.ticks.dtype == later.ticks.dtype and self.per_second == later.per_second:
            return float(self._scaled(later.ticks[:1] - self.ticks[-1:])[0])
        return float(later.seconds[0] - self.seconds[-1])

    def _scaled(self, ticks: NDArray[Any]) -> Array:
        wide = ticks.astype(np.float64) * float(self.per_second.denominator)
        return np.asarray(wide / float(self.per_second.numerator))


class Unreadable(Exception):
    """A time that is none; ``index`` is its place in the piece."""

    def __init__(self, index: int, given: str) -> None:
        self.index, self.given = index, given
        super().__init__(given)


def read_times(column: Any, unit: Fraction | None, decimal: str = ".") -> Times:
    """Times of a column as it is written or typed; ``unit``: how many a second has."""
    if column.null_count:
        raise Unreadable(column.is_null().index(pa.scalar(True)).as_py(), "nothing")  # noqa: FBT003
    kind = column.type
    texts = column if pa.types.is_string(kind) else arrow.cast(column, pa.string())
    if pa.types.is_string(kind):
        return _of_texts(texts, unit, decimal)
    if pa.types.is_timestamp(kind) or pa.types.is_duration(kind) or pa.types.is_time(kind):
        narrow = pa.int64() if kind.bit_width == 64 else pa.int32()
        ticks, per = as_numpy(column.cast(narrow)).astype(np.int64), _PER_SECOND[kind.unit]
        return Times(ticks, _first(ticks) / per, Fraction(per), texts, "ISO 8601")
    if pa.types.is_integer(kind):
        ticks = as_numpy(arrow.cast(column, pa.int64()))
        return _counted(ticks, 1, texts, unit)
    if pa.types.is_floating(kind):
        return _counted(_finite(as_numpy(column).astype(np.float64), texts), 1, texts, unit)
    raise Unreadable(0, f"type {kind}")


def _of_texts(texts: Any, unit: Fraction | None, decimal: str) -> Times:
    comma = decimal == "," or _has_commas(texts)
    plain = arrow.replace_substring(texts, ",", ".") if comma else texts
    with suppress(pa.ArrowInvalid):
        return _counted(as_numpy(plain.cast(pa.int64())), 1, texts, unit)
    with suppress(pa.ArrowInvalid):
        exact = plain.cast(_DIGITS)
        ticks = np.frombuffer(exact.buffers()[1], np.int64)[::2][exact.offset :][: len(exact)]
        return _counted(ticks.copy(), _NANO, texts, unit, first=float(exact[0].as_py()))
    with suppress(pa.ArrowInvalid):
        numbers = as_numpy(plain.cast(pa.float64()))
        return _counted(_finite(numbers, texts), 1, texts, unit)
    ticks = _dated(texts)
    return Times(ticks, _first(ticks) / _NANO, Fraction(_NANO), texts, "ISO 8601")


def _has_commas(texts: Any) -> bool:
    """Whether times have a decimal comma of their own; 1,234 may be a thousand."""
    if arrow.any(arrow.match_substring(texts, ".")).as_py():
        return False
    with_comma = texts.filter(arrow.match_substring(texts, ","))
    thousands = arrow.match_substring_regex(with_comma, r"^[+-]?[1-9]\d{0,2}(,\d{3})+$")
    return len(with_comma) > 0 and not arrow.all(thousands).as_py()


def _counted(
    ticks: NDArray[Any],
    per_unit: int,
    texts: Any,
    unit: Fraction | None,
    *,
    first: float | None = None,
) -> Times:
    """Times that are numbers, in the unit stated or in that of their size."""
    first = _first(ticks) / per_unit if first is None else first
    kind = ""
    if unit is None:
        kind, epoch = next((kind, scale) for most, kind, scale in _EPOCHS if abs(first) < most)
        unit = Fraction(epoch)
    last = 0.0
    if ticks.dtype == np.int64:
        digits = (str(text).partition(".")[2] for text in texts[:100])
        last = 10.0 ** -max(map(len, digits)) / float(unit)
    return Times(ticks, float(first / unit), per_unit * unit, texts, kind, last)


def _first(ticks: NDArray[Any]) -> float:
    return float(ticks[0])


def _finite(numbers: Array, texts: Any) -> Array:
    wrong = np.flatnonzero(~np.isfinite(numbers))
    if wrong.size:
        raise Unreadable(int(wrong[0]), str(texts[int(wrong[0])]))
    return numbers


def _dated(texts: Any) -> NDArray[np.int64]:
    """Nanoseconds of ISO 8601, all with a zone or all without; or of hours, minutes, seconds."""
    plain = arrow.replace_substring_regex(texts, r"(:\d+),(\d+)", r"\1.\2")
    for kind in (pa.timestamp("ns"), pa.timestamp("ns", "UTC")):
        for prefix in ("", "1970-01-01T"):
            whole = arrow.binary_join_element_wise(prefix, plain, "") if prefix else plain
            try:
                return as_numpy(whole.cast(kind).cast(pa.int64()))
            except pa.ArrowInvalid:
                continue
    listed = plain.to_pylist()
    if _is_number(listed[0]):  # then the first that is none is what is wrong
        index = next((i for i, text in enumerate(listed) if not _is_number(text)), 0)
        raise Unreadable(index, repr(listed[index][:40]))
    return np.array([_date(i, text) for i, text in enumerate(listed)], np.int64)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _date(index: int, text: str) -> int:
    """Nanoseconds of one date in any of the forms of ISO 8601."""
    try:
        moment = datetime.fromisoformat(text)
        since = moment.astimezone(UTC) if moment.tzinfo else moment.replace(tzinfo=UTC)
        return (round(since.timestamp() // 1) * 1_000_000 + since.microsecond) * 1000
    except ValueError:
        raise Unreadable(index, repr(text[:40])) from None
