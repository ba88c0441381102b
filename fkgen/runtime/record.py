"""Check a record before it goes to C: shapes, types, parameter names."""

from __future__ import annotations

import contextlib
import difflib
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.errors import DataError
from fkgen.runtime.layout import Layout

Array = NDArray[np.floating]


def dtype_of(layout: Layout) -> type[np.floating]:
    """The NumPy scalar of a filter."""
    return np.float64 if layout.scalar == "double" else np.float32


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
    q, dtype = len(layout.inputs), dtype_of(layout)
    names = ", ".join(layout.inputs)
    if u is None:
        if q:
            raise DataError("u", given="nothing", expected=f"shape (T, {q}): {names}")
        return np.zeros((samples, 0), dtype)
    if not q:
        if np.size(u):
            raise DataError("u", given="inputs", expected="none: the model has no B")
        return np.zeros((samples, 0), dtype)
    array = signal("u", u, q, dtype)
    if len(array) != samples:
        raise DataError("u", given=f"{len(array)} samples", expected=f"{samples}, as many as y has")
    return array


def parameters(layout: Layout, given: Mapping[str, ArrayLike] | None, samples: int) -> list[Array]:
    """One array per parameter, of one value or of one per sample."""
    values = dict(given or {})
    known = [name for name, _ in layout.parameters]
    for name in values:
        if name not in known:
            raise DataError(f"params.{name}", given="an unknown name", expected=choice(name, known))
    dtype = dtype_of(layout)
    result = []
    for name, default in layout.parameters:
        array = np.atleast_1d(numbers(f"params.{name}", values.get(name, default), dtype))
        if array.shape not in ((1,), (samples,)):
            raise DataError(
                f"params.{name}",
                given=f"shape {array.shape}",
                expected=f"a number or shape ({samples},)",
            )
        if not np.isfinite(array).all():
            at = int(np.flatnonzero(~np.isfinite(array))[0])
            raise DataError(
                f"params.{name}[{at}]", given=str(array[at]), expected="a finite number"
            )
        result.append(array)
    return result


def kept(layout: Layout, keep: Sequence[str] | None) -> frozenset[str]:
    """Names of the ports to store; all of them by default."""
    known = [port.name for port in layout.ports]
    if keep is None:
        return frozenset(known)
    names = [keep] if isinstance(keep, str) else list(keep)
    for name in names:
        if name not in known and name != "status":
            raise DataError("keep", given=repr(name), expected=choice(name, known))
    return frozenset(names)


def choice(name: str, known: Sequence[str]) -> str:
    """What could have been meant."""
    close = difflib.get_close_matches(str(name), known, n=1)
    if not known:
        return "nothing: the filter has none"
    return f"{close[0]!r}" if close else f"one of: {', '.join(known)}"
