"""Check what a user gives at run time: records before they go to C, parameters, numbers."""

from __future__ import annotations

import contextlib
import difflib
import math
import os
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError, names_of
from fkgen.runtime.layout import Layout
from fkgen.runtime.values import column_of, headings, is_plain, place, read
from fkgen.symbolic.interface import Port

Array = NDArray[np.floating]

_QUICK = frozenset((float, int, list, tuple))  # types of which most samples are
_INPUT = "an input is never missing"

#: Bytes from which on a copy of what is given is worth a warning.
NOTED = 2**28


def numbers(
    what: str,
    value: Any,
    dtype: type[np.floating],
    names: Sequence[str] = (),
    *,
    role: str = "",
) -> Array:
    """Anything numeric as a contiguous array; no copy if it is one already.

    What is marked as missing is NaN, or an error where a value has a ``role`` that forbids it.
    """
    if type(value) is np.ndarray and value.dtype == dtype:
        return np.ascontiguousarray(value)
    if dtype is np.float64 and type(value) in _QUICK and is_plain(value):
        with contextlib.suppress(ValueError, OverflowError):  # ragged, or huge: told below
            return np.array(value, dtype, ndmin=1)
    found = read(what, value, names)
    if role and found.missing is not None:
        where = place(what, np.argwhere(found.missing)[0].tolist(), names)
        raise DataError(where, given="a missing value", expected=f"a number: {role}")
    with np.errstate(over="ignore"):  # an infinity is what the filter refuses
        return np.ascontiguousarray(found.array, dtype=dtype)


def signal(
    what: str,
    value: Any,
    width: int,
    dtype: type[np.floating],
    names: Sequence[str] = (),
    *,
    role: str = "",
) -> Array:
    """A record of shape (T, width); (T,) is taken as one column when the width is one."""
    array = numbers(what, value, dtype, names, role=role)
    if array.ndim == 1 and width == 1:
        array = array[:, np.newaxis]
    if array.ndim != 2 or array.shape[1] != width:
        expected = f"shape (T, {width}){_listed(names)}"
        raise DataError(what, given=f"shape {array.shape}", expected=expected)
    return array


def measurements(layout: Layout, y: Any) -> Array:
    """The measurements of a record, (T, p)."""
    if y is None:
        p = len(layout.outputs)
        raise DataError("y", given="nothing", expected=f"shape (T, {p}){_listed(layout.outputs)}")
    return signal("y", y, len(layout.outputs), layout.dtype, layout.outputs)


def inputs(layout: Layout, u: Any, samples: int) -> Array:
    """The inputs of a record, (T, q)."""
    q = len(layout.inputs)
    if u is None and q:
        raise DataError("u", given="nothing", expected=f"shape (T, {q}){_listed(layout.inputs)}")
    if not q:
        if u is not None and _size(u):
            raise DataError("u", given="inputs", expected="none: the model has no B")
        return np.zeros((samples, 0), layout.dtype)
    array = signal("u", u, q, layout.dtype, layout.inputs, role=_INPUT)
    if len(array) != samples:
        expected = f"{samples}, as many as y has{_listed(layout.inputs)}"
        raise DataError("u", given=f"{len(array)} samples", expected=expected)
    return array


def batch(layout: Layout, y: Any, u: Any) -> tuple[Array, Array]:
    """Measurements (M, T, p), and inputs (M, T, q) or, for all records, (T, q)."""
    dtype, p = layout.dtype, len(layout.outputs)
    given = _each("y", y, layout.outputs)
    note_copy("y", given, dtype)
    records = numbers("y", given, dtype, layout.outputs)
    if records.ndim != 3 or records.shape[2] != p:
        expected = f"shape (M, T, {p}){_listed(layout.outputs)}"
        raise DataError("y", given=f"shape {records.shape}", expected=expected)
    M, T = records.shape[:2]
    if u is None or not (layout.inputs or _size(u)):
        return records, inputs(layout, u, T)
    given = _each("u", u, layout.inputs)
    note_copy("u", given, dtype)
    driven = numbers("u", given, dtype, layout.inputs, role=_INPUT)
    if driven.ndim != 3:
        return records, inputs(layout, driven, T)
    if len(driven) != M:
        raise DataError("u", given=f"{len(driven)} records", expected=f"{M}, as y has")
    for first in driven[:1]:
        inputs(layout, first, T)
    return records, driven


def memory() -> int:
    """Bytes of memory of this machine; 0 if it does not say."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return 0


def note_copy(what: str, value: Any, dtype: type[np.floating]) -> None:
    """Say so where a large array has to be copied, before it is; refuse what has no room."""
    if not isinstance(value, np.ndarray) or (value.dtype == dtype and value.flags.c_contiguous):
        return
    size = value.size * np.dtype(dtype).itemsize
    afford(what, f"numbers whose copy takes {_gigabytes(size)}", size)
    if size >= NOTED:
        kind = np.dtype(dtype).name
        text = f"{what} is copied ({_gigabytes(size)}): a C-contiguous array of {kind} is not"
        warnings.warn(text, stacklevel=4)


def afford(what: str, given: str, size: int) -> None:
    """Refuse what this machine has no memory for."""
    if 0 < memory() < size:
        expected = f"at most {_gigabytes(memory())}, the memory of this machine"
        raise DataError(what, given=given, expected=f"{expected}: fewer ports or records at a time")


def _gigabytes(size: int) -> str:
    return f"{size / 2**30:.3g} GiB"


def sample(what: str, value: Any, names: Sequence[str], dtype: type[np.floating]) -> Array:
    """One sample of signals of these names; of y all of it may be missing."""
    measured, width = what == "y", len(names)
    shape = f"shape ({width},){_listed(names)}"
    if measured and (value is None or value is np.ma.masked):
        return np.full(width, np.nan, dtype)
    if value is None:
        raise DataError(what, given="nothing", expected=f"numbers of {shape}")
    labels = getattr(value, "index", None)
    if labels is not None and not callable(labels) and set(names) <= set(labels):
        value = {name: value[name] for name in names}  # a row of a frame
    role = "" if measured else _INPUT
    array = numbers(what, value, dtype, names, role=role)
    if array.size != width or sorted(array.shape)[:-1] != [1] * (array.ndim - 1):
        raise DataError(what, given=f"shape {array.shape}", expected=shape)
    return array.reshape(width)


def values_of(
    named: Sequence[tuple[str, float]],
    given: Any,
    samples: int,
    dtype: type[np.floating],
    *,
    records: int | None = None,
) -> list[Array]:
    """One array per parameter: (1,), (samples,), or of several records (M, samples) or (M, 1)."""
    values = _mapping(given, [name for name, _ in named])
    result = []
    for name, default in named:
        what = f"params.{name}"
        value = values.get(name, default)
        array = np.atleast_1d(numbers(what, value, dtype, role="a parameter is never missing"))
        if array.shape not in ((1,), (samples,), (records, samples), (records, 1)):
            several = "" if records is None else f" or ({records}, {samples})"
            expected = f"a number or shape ({samples},){several}"
            raise DataError(what, given=f"shape {array.shape}", expected=expected)
        if array.size == 1 and not np.isfinite(array).all():  # else the samples are held
            at = tuple(np.argwhere(~np.isfinite(array))[0].tolist())
            raise DataError(place(what, at, ()), given=str(array[at]), expected="a finite number")
        result.append(array)
    return result


def _mapping(given: Any, known: Sequence[str]) -> Mapping[str, Any]:
    """Values of parameters by name; of a frame those columns that are parameters."""
    if given is None:
        return {}
    if isinstance(given, Mapping):
        values = _scalars(given, known)
        for name in values:
            if name not in known:
                expected = choice(name, known)
                raise DataError(f"params.{name}", given="an unknown name", expected=expected)
        return values
    columns = headings(given)
    if columns is None:
        kind = f"a value of type {type(given).__name__}"
        expected = "a mapping of names to numbers, or a frame"
        raise DataError("params", given=kind, expected=f"{expected}{_listed(known)}")
    found = {name: column_of("params", given, name) for name in known if name in columns}
    if not found:
        there = f"columns {', '.join(map(str, columns))}"
        raise DataError("params", given=there, expected=choice(str(next(iter(columns), "")), known))
    return found


def _scalars(given: Mapping[Any, Any], known: Sequence[str]) -> Mapping[Any, Any]:
    """Vectors as their entries: of m they are m_0, m_1, ..."""
    found: dict[Any, Any] = {}
    for name, value in given.items():
        parts = [f"{name}_{i}" for i in range(len(known)) if f"{name}_{i}" in known]
        if name in known or len(parts) < 2:
            found[name] = value
            continue
        role = "a parameter is never missing"
        array = numbers(f"params.{name}", value, np.float64, role=role)
        if array.shape[-1] != len(parts):
            expected = f"{len(parts)} numbers, or as many columns"
            raise DataError(f"params.{name}", given=f"shape {array.shape}", expected=expected)
        found |= {part: array[..., i] for i, part in enumerate(parts)}
    return found


def _each(what: str, value: Any, names: Sequence[str]) -> Any:
    """Of a list of frames the records (M, T, w); anything else as it is."""
    if not isinstance(value, list | tuple) or not value or headings(value[0]) is None:
        return value
    frames = [read(f"{what}[{m}]", frame, names) for m, frame in enumerate(value)]
    for m, frame in enumerate(frames):
        if frame.array.shape != frames[0].array.shape:
            given, expected = (f"shape {each.array.shape}" for each in (frame, frames[0]))
            raise DataError(f"{what}[{m}]", given=given, expected=f"{expected}, as {what}[0] has")
    masks = [np.zeros(f.array.shape, bool) if f.missing is None else f.missing for f in frames]
    return np.ma.array(np.stack([frame.array for frame in frames]), mask=np.stack(masks))


def _size(value: Any) -> int:
    """How many numbers something holds, as far as it can be told."""
    try:
        return int(np.size(value))
    except Exception:  # noqa: BLE001 - what has no size holds something
        return 1


def _listed(names: Sequence[str]) -> str:
    return f": {', '.join(names)}" if names else ""


def kept(layout: Layout, keep: Sequence[str] | None) -> list[Port]:
    """The ports to store; all of them by default."""
    known = [port.name for port in layout.ports]
    usual = [port.name for port in layout.ports if not port.inner]
    names = usual if keep is None else names_of("keep", keep, "names of ports")
    for name in names:
        if name not in known and name != "status":
            raise DataError("keep", given=repr(name), expected=choice(name, known))
    return [port for port in layout.ports if port.name in names]


def choice(name: str, known: Sequence[str]) -> str:
    """What could have been meant."""
    close = difflib.get_close_matches(str(name), known, n=1)
    if not known:
        return "nothing: the filter has none"
    return f"{close[0]!r}" if close else f"one of: {', '.join(known)}"


def probability(name: str, value: Any) -> float:
    """A probability strictly between 0 and 1."""
    try:
        number = math.nan if np.ma.is_masked(value) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not 0.0 < number < 1.0:
        raise DataError(name, given=repr(value), expected="a probability in (0, 1), such as 0.001")
    return number


def whole(name: str, value: Any, *, least: int, expected: str, most: float = math.inf) -> int:
    """A whole number within bounds."""
    number = not isinstance(value, bool) and isinstance(value, int | np.integer)
    if not number or not least <= value <= most:
        raise DataError(name, given=repr(value), expected=expected)
    return int(value)
