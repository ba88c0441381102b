"""Check what a user gives at run time: records before they go to C, parameters, numbers."""

from __future__ import annotations

import contextlib
import difflib
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.errors import DataError, names_of
from fkgen.runtime.layout import Layout
from fkgen.symbolic.interface import Port

Array = NDArray[np.floating]


def numbers(what: str, value: ArrayLike, dtype: type[np.floating]) -> Array:
    """Anything numeric as a contiguous array; no copy if it is one already."""
    array = np.asarray(value)
    if array.dtype.kind == "O":
        with contextlib.suppress(TypeError, ValueError):
            array = array.astype(np.float64)
    if array.dtype.kind not in "fiu":
        kind = "text" if array.dtype.kind in "US" else f"type {array.dtype.name}"
        raise DataError(what, given=kind, expected="real numbers")
    return np.ascontiguousarray(array, dtype=dtype)


def signal(what: str, value: ArrayLike, width: int, dtype: type[np.floating]) -> Array:
    """A record of shape (T, width); (T,) is taken as one column when the width is one."""
    array = numbers(what, value, dtype)
    if array.ndim == 1 and width == 1:
        array = array[:, np.newaxis]
    if array.ndim != 2 or array.shape[1] != width:
        raise DataError(what, given=f"shape {array.shape}", expected=f"shape (T, {width})")
    return array


def inputs(layout: Layout, u: ArrayLike | None, samples: int) -> Array:
    """The inputs of a record, (T, q)."""
    q = len(layout.inputs)
    if u is None and q:
        names = ", ".join(layout.inputs)
        raise DataError("u", given="nothing", expected=f"shape (T, {q}): {names}")
    if not q:
        if u is not None and np.size(u):
            raise DataError("u", given="inputs", expected="none: the model has no B")
        return np.zeros((samples, 0), layout.dtype)
    array = signal("u", np.asarray(u), q, layout.dtype)
    if len(array) != samples:
        raise DataError("u", given=f"{len(array)} samples", expected=f"{samples}, as many as y has")
    return array


def batch(layout: Layout, y: ArrayLike, u: ArrayLike | None) -> tuple[Array, Array | None]:
    """Measurements (M, T, p), and inputs (M, T, q) or (T, q) as they were given."""
    dtype, p = layout.dtype, len(layout.outputs)
    records = numbers("y", y, dtype)
    if records.ndim != 3 or records.shape[2] != p:
        raise DataError("y", given=f"shape {records.shape}", expected=f"shape (M, T, {p})")
    driven = None if u is None else numbers("u", u, dtype)
    if driven is not None and driven.ndim == 3 and len(driven) != len(records):
        given, expected = f"{len(driven)} records", f"{len(records)}, as y has"
        raise DataError("u", given=given, expected=expected)
    return records, driven


def values_of(
    named: Sequence[tuple[str, float]],
    given: Mapping[str, ArrayLike] | None,
    samples: int,
    dtype: type[np.floating],
    *,
    records: int | None = None,
) -> list[Array]:
    """One array per parameter: (1,), (samples,) or, for several records, (records, samples)."""
    values = dict(given or {})
    known = [name for name, _ in named]
    for name in values:
        if name not in known:
            raise DataError(f"params.{name}", given="an unknown name", expected=choice(name, known))
    result = []
    for name, default in named:
        array = np.atleast_1d(numbers(f"params.{name}", values.get(name, default), dtype))
        if array.shape not in ((1,), (samples,), (records, samples)):
            several = "" if records is None else f" or ({records}, {samples})"
            raise DataError(
                f"params.{name}",
                given=f"shape {array.shape}",
                expected=f"a number or shape ({samples},){several}",
            )
        if array.size == 1 and not np.isfinite(array).all():  # else the samples are held
            at = tuple(np.argwhere(~np.isfinite(array))[0].tolist())
            where = ", ".join(map(str, at))
            raise DataError(
                f"params.{name}[{where}]", given=str(array[at]), expected="a finite number"
            )
        result.append(array)
    return result


def kept(layout: Layout, keep: Sequence[str] | None) -> list[Port]:
    """The ports to store; all of them by default."""
    known = [port.name for port in layout.ports]
    names = known if keep is None else names_of("keep", keep, "names of ports")
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
        number = float(value)
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
