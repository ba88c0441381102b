"""Numbers as Python users hold them: arrays, lists with None, masked arrays, frames, series.

What is marked as missing (None, a mask, NA) is kept apart from NaN: it may be missing in y only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from itertools import chain
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError

Array = NDArray[np.floating]

_NOTHING = frozenset(("NoneType", "MaskedConstant", "NAType", "NaTType", "NullType"))
_REAL: Any = (Real, Decimal)
_NUMBERS, _LISTS = frozenset((float, int)), frozenset((list, tuple))
_LONGEST = 40  # characters of a value in an error


@dataclass(frozen=True, slots=True, eq=False)
class Values:
    """Numbers, and where a value is marked as missing; there the number is NaN."""

    array: Array
    missing: NDArray[np.bool_] | None = None


def read(what: str, value: Any, names: Sequence[str] = ()) -> Values:
    """Anything that holds real numbers; the columns of a frame are found by ``names``."""
    try:
        return _read(what, value, tuple(names))
    except DataError:
        raise
    except Exception as error:  # noqa: BLE001 - objects of other libraries raise what they like
        given = f"a {type(value).__name__} that cannot be read ({_short(error)})"
        raise DataError(what, given=given, expected=_numbers(names)) from None


def headings(value: Any) -> tuple[Any, ...] | None:
    """Names of the columns of a frame, a structured array or a mapping; None if it is neither."""
    if isinstance(value, np.ndarray):
        fields: tuple[Any, ...] | None = value.dtype.names
        return fields
    if isinstance(value, Mapping):
        return tuple(value)
    if not hasattr(value, "__getitem__"):
        return None
    found = getattr(value, "column_names", getattr(value, "columns", None))
    return None if found is None or callable(found) else tuple(found)


def column_of(what: str, frame: Any, name: str) -> Any:
    """A column that is there once."""
    column = frame[name]
    if getattr(column, "ndim", 1) > 1:
        raise DataError(f"{what}.{name}", given="several columns of this name", expected="one")
    return column


def place(what: str, index: Sequence[int], names: Sequence[str]) -> str:
    """Where an element stands: ``y.gnss[3]``, or ``y[3, 0]`` without names."""
    at = list(map(int, index))
    if names and (len(names) == 1 or at):
        width = len(names)
        column = at.pop() if width > 1 or len(at) > 1 else 0
        what = f"{what}.{names[column]}" if column < width else what
    return f"{what}[{', '.join(map(str, at))}]" if at else what


def _read(what: str, value: Any, names: tuple[str, ...]) -> Values:
    columns = headings(value)
    if columns is not None:
        return _frame(what, value, columns, names)
    marked = None
    if isinstance(value, np.ma.MaskedArray):
        marked, value = np.ma.getmaskarray(value), np.ma.getdata(value)
    elif hasattr(value, "is_null"):  # a series of polars, an array of pyarrow
        marked, value = np.asarray(value.is_null()), np.asarray(value)
    elif not isinstance(getattr(value, "dtype", np.dtype(float)), np.dtype):
        value = value.to_numpy(dtype=object)  # a nullable series of pandas
    array = _array(what, value, names)
    if array.dtype.kind == "O":
        array, gone = _elements(what, array, names, marked)
        marked = gone if marked is None else marked | gone
    if array.dtype.kind not in "fiu":
        raise _unfit(what, array, names)
    if marked is None or not marked.any():
        return Values(array)
    return Values(np.where(marked, np.nan, array.astype(np.float64)), marked)


def _frame(what: str, frame: Any, columns: tuple[Any, ...], names: tuple[str, ...]) -> Values:
    """Columns by name, in the order of the names; further columns are ignored."""
    absent = [name for name in names if name not in columns]
    if absent or not names:
        there = _short(", ".join(map(str, columns)), 2 * _LONGEST)
        given = f"columns {there or 'without names'}"
        expected = f"a column for each of: {', '.join(names)}" if names else "numbers"
        raise DataError(what, given=given, expected=expected)
    found = [_read(f"{what}.{name}", column_of(what, frame, name), ()) for name in names]
    sizes = [each.array.shape for each in found]
    for name, shape in zip(names, sizes, strict=True):
        if shape != sizes[0]:
            expected = f"shape {sizes[0]}, as {names[0]} has"
            raise DataError(f"{what}.{name}", given=f"shape {shape}", expected=expected)
    marked = [np.zeros(e.array.shape, bool) if e.missing is None else e.missing for e in found]
    array = np.stack([each.array for each in found], axis=-1)
    missing = np.stack(marked, axis=-1)
    return Values(array, missing if missing.any() else None)


def _array(what: str, value: Any, names: tuple[str, ...]) -> NDArray[Any]:
    """An array of any type; of lists, one whose rows have the same length."""
    if not isinstance(value, list | tuple):
        return np.asarray(value)
    rows = None if is_plain(value) else _rows(value)
    lengths = [len(row) for row in (value if rows is None else rows) if _is_row(row)]
    for k, length in enumerate(lengths):
        if length != lengths[0]:
            given, expected = f"{length} numbers in sample {k}", f"{lengths[0]}, as in sample 0"
            raise DataError(what, given=given, expected=_with(expected, names))
    if is_plain(value):
        return np.asarray(value)
    array = np.array(value if rows is None else rows, dtype=object)
    return array if array.size else np.zeros(array.shape)


def _rows(value: Sequence[Any]) -> list[Any] | None:
    """Rows of a list of lists, without masks, None as a row of None; None if there are none."""
    plain = [each.tolist() if isinstance(each, np.ma.MaskedArray) else each for each in value]
    nested = [each for each in plain if _is_row(each)]
    if not nested:
        return None if all(a is b for a, b in zip(plain, value, strict=True)) else plain
    empty = [None] * len(nested[0])
    rows = [empty if type(each).__name__ in _NOTHING else each for each in plain]
    inner = [_rows(each) if isinstance(each, list | tuple) else None for each in rows]
    return [row if found is None else found for row, found in zip(rows, inner, strict=True)]


def is_plain(value: Any) -> bool:
    """Whether it is a float, an int, or a list of them or of lists of them."""
    kind = type(value)
    if kind is float or kind is int:
        return True
    if kind is not list and kind is not tuple:
        return False
    kinds = set(map(type, value))
    if kinds and kinds <= _LISTS:
        kinds = set(map(type, chain.from_iterable(value)))
    return kinds <= _NUMBERS


def _is_row(value: Any) -> bool:
    return isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.ndim > 0)


def _elements(
    what: str, array: NDArray[Any], names: tuple[str, ...], ignored: NDArray[np.bool_] | None
) -> tuple[Array, NDArray[np.bool_]]:
    """Objects one by one: real numbers, or marks of what is missing."""
    numbers, missing = np.full(array.shape, np.nan), np.zeros(array.shape, bool)
    for index, each in np.ndenumerate(array):
        if type(each).__name__ in _NOTHING or (ignored is not None and ignored[index]):
            missing[index] = True
        elif isinstance(each, _REAL) and type(each) is not bool:
            try:
                numbers[index] = float(each)
            except OverflowError:
                numbers[index] = np.inf if each > 0 else -np.inf
        else:
            where = place(what, index, names)
            raise DataError(where, given=_described(each), expected="a real number")
    return numbers, missing


def _unfit(what: str, array: NDArray[Any], names: tuple[str, ...]) -> DataError:
    """The error about an array whose type holds no real numbers."""
    if array.dtype.kind in "US" and array.size:
        where = place(what, (0,) * array.ndim, names)
        return DataError(where, given=_described(array.flat[0]), expected="a real number")
    kind = "text" if array.dtype.kind in "US" else f"type {array.dtype.name}"
    return DataError(what, given=kind, expected=_numbers(names))


def _described(value: Any) -> str:
    """A value that is no number."""
    if isinstance(value, str | bytes):
        return f"text {_short(repr(str(value)))}"
    return f"{_short(value)} of type {type(value).__name__}"


def _numbers(names: Sequence[str]) -> str:
    return _with("real numbers", names)


def _with(expected: str, names: Sequence[str]) -> str:
    return f"{expected} ({', '.join(names)})" if names else expected


def _short(value: object, longest: int = _LONGEST) -> str:
    """One short line, whatever it is."""
    try:
        text = " ".join(str(value).split())
    except Exception:  # noqa: BLE001 - even a text can be too much to ask
        text = type(value).__name__
    return text if len(text) <= longest else f"{text[:longest]}..."
