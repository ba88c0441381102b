"""Profiles of faults over a record: what is added to y or to u, sample by sample.

Every function returns shape (steps, width), where the width is the length of the amplitude: one
number per row of y (or per input), zero for those that stay healthy. All of them refuse samples
that are not in the record and amplitudes that are not finite with a `DataError`.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.errors import DataError, names_of, of_type
from fkgen.runtime.record import whole
from fkgen.study.records.table import read_columns

Array = NDArray[np.float64]

_SAMPLES, _MOST = "a number of samples, at least 1", 2**31

_NAMES = "names of columns, one per row of y or per input"


def pulse(steps: int, start: int, amplitude: ArrayLike) -> Array:
    """A fault of one sample.

    Shapes: amplitude (width,).
    """
    first = whole("start", start, least=0, expected="a sample of the record")
    return step(steps, first, amplitude, stop=first + 1)


def step(steps: int, start: int, amplitude: ArrayLike, *, stop: int | None = None) -> Array:
    """A constant fault from ``start`` on, up to and without ``stop``.

    Parameters
    ----------
    steps, start, amplitude
        As for `pulse`; ``start`` is the first faulty sample.
    stop : int, optional
        First healthy sample after it; one beyond the record, or None, means that it stays.
    """
    return _shaped(np.ones(_count(steps)), start, amplitude, stop)


def ramp(
    steps: int, start: int, amplitude: ArrayLike, *, length: int, stop: int | None = None
) -> Array:
    """A fault that rises to ``amplitude`` within ``length`` samples and stays there.

    Sample ``start`` has amplitude / length, sample start + length - 1 the whole of it.
    """
    whole("length", length, least=1, most=_MOST, expected=_SAMPLES)
    rise = np.minimum(np.arange(1, _count(steps) + 1) / length, 1.0)
    return _shaped(rise, start, amplitude, stop)


def drift(steps: int, start: int, rate: ArrayLike, *, stop: int | None = None) -> Array:
    """A fault that grows by ``rate`` per sample: rate at ``start``, 2 rate after it, and so on.

    Shapes: rate (width,).
    """
    return _shaped(np.arange(1.0, _count(steps) + 1.0), start, rate, stop)


def from_csv(path: str | os.PathLike[str], columns: Sequence[str]) -> Array:
    """A profile from a CSV file with a header; a column that the file lacks is zero."""
    of_type("path", path, (str, os.PathLike), "the path of a CSV file")
    names = names_of("columns", columns, _NAMES)
    if not names:
        raise DataError("columns", given="none", expected=_NAMES)
    return np.stack(list(read_columns(path, names).values()), axis=1)


def _count(steps: int) -> int:
    return whole("steps", steps, least=1, most=_MOST, expected=_SAMPLES)


def _shaped(shape: Array, start: int, amplitude: ArrayLike, stop: int | None) -> Array:
    """Put the first values of a shape from ``start`` on, times the amplitude."""
    steps = len(shape)
    in_record = f"a sample from 0 to {steps - 1}"
    first = whole("start", start, least=0, most=steps - 1, expected=in_record)
    later = f"a sample after start = {start}, or None: the fault stays"
    last = steps if stop is None else whole("stop", stop, least=first + 1, expected=later)
    try:
        size = np.atleast_1d(np.asarray(amplitude, dtype=float))
    except (TypeError, ValueError, OverflowError):
        size = np.full((0, 0), np.nan)
    if size.ndim != 1 or not size.size or not np.isfinite(size).all():
        expected = "finite numbers, one per row of y or per input"
        raise DataError("amplitude", given=repr(amplitude), expected=expected)
    result = np.zeros((steps, size.size))
    last = min(last, steps)
    result[first:last] = shape[: last - first, np.newaxis] * size
    return result
