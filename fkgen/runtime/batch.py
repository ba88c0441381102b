"""Several records in one call: what C is given, and the library that takes them in lanes."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

_POINTER = ctypes.c_void_p


class Batch(ctypes.Structure):
    """Records and the places of their results, as in ``batch.h.j2``."""

    _fields_ = (
        ("records", ctypes.c_int64),
        ("samples", ctypes.c_int64),
        ("instances", _POINTER),
        ("started", ctypes.c_int64),
        ("params", _POINTER),
        ("strides", _POINTER),
        ("u", _POINTER),
        ("driven", ctypes.c_int64),
        ("y", _POINTER),
        ("out", _POINTER),
        ("status", _POINTER),
        ("held", _POINTER),
    )

    @property
    def instance(self) -> bytes:
        """The first instance, as it is now."""
        return bytes(self.lives[0][0])

    @classmethod
    def of(
        cls,
        instances: Array,
        data: tuple[Array, Array],
        parameters: Sequence[Array],
        results: tuple[Sequence[Array | None], Array, Array],
    ) -> Self:
        """Arrays as C reads them; they live as long as the value.

        Parameters
        ----------
        instances : (1, bytes) or (M, bytes) array
            Where all records start, or where each does; the latter move on.
        data : (M, T, p) array, and (T, q) or (M, T, q) array
            Measurements and inputs.
        parameters : sequence of (1,), (T,) or (M, T) array
        results : ports that are wanted, or None; (M, T) status; (M, T) held
        """
        y, u = data
        (M, T), (out, status, held) = y.shape[:2], results
        steps = [(T if v.ndim == 2 else 0, int(v.shape[-1] > 1)) for v in parameters]
        strides = np.array(steps, np.int64)
        places = np.array([each.ctypes.data for each in parameters], np.uintp)
        to = np.array([0 if each is None else each.ctypes.data for each in out], np.uintp)
        lives = (instances, strides, places, to, y, u, *parameters, *results)
        at = [each.ctypes.data for each in (instances, places, strides, u, y, to, status, held)]
        own, driven = len(instances) > 1 or M == 1, u[0].size if u.ndim == 3 else 0
        batch = cls(M, T, at[0], own, at[1], at[2], at[3], driven, at[4], at[5], at[6], at[7])
        batch.lives = lives
        return batch


#: Filters the records from one to another.
Records = Callable[[Batch, int, int], None]


def of_records(function: Any, *more: Any) -> Records:
    """A C function that filters records; ``more`` are its further arguments."""
    function.argtypes = (_POINTER, ctypes.c_int64, ctypes.c_int64, *[_POINTER] * len(more))
    function.restype = None

    def call(batch: Batch, first: int, stop: int) -> None:
        function(ctypes.byref(batch), first, stop, *more)

    return call


def work_in_lanes(folder: Path, name: str, alone: Any) -> Records | None:
    """The function that takes several records at once, compiled if it is not yet; None if there is none.

    Parameters
    ----------
    folder : Path
        The entry of a filter in the cache.
    name : str
        The name of the filter.
    alone : pointer
        The C function that does one sample of one record.
    """
    from fkgen.runtime.compiler import lanes_library  # noqa: PLC0415 - it imports this module

    source = folder / f"{name}_lanes.c"
    library = lanes_library(source)
    if library is None:
        return None
    try:
        found = ctypes.CDLL(str(library))
    except OSError:  # made for another machine
        return None
    if found[f"{name}_lanes"]() < 2:
        return None
    return of_records(found[f"{name}_lanes_records"], alone)
