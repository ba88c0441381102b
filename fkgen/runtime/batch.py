"""Several records in one call: what C is given, and the library that takes them in lanes."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from fkgen.runtime.layout import Layout

Array = NDArray[Any]

_POINTER = ctypes.c_void_p

#: Operations without lanes from which on it pays to compile them: those take as long as a compiler,
#: so whatever comes afterwards, nobody waits more than twice as long as need be.
WORTH, WORTH_A_STATEMENT = 200_000_000, 3_000_000


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
        parameters : sequence of (1,), (T,), (M, T) or (M, 1) array
        results : ports that are wanted, or None; (M, T) status; (M, T) held
        """
        y, u = data
        (M, T), (out, status, held) = y.shape[:2], results
        steps = [(v.shape[1] if v.ndim == 2 else 0, int(v.shape[-1] > 1)) for v in parameters]
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


class Lanes:
    """The library that takes several records of a filter at once, found or made when it pays.

    A batch that does without has the same bits: the library is compiled once the operations that
    were done without it are worth its compilation, and kept beside the filter.
    """

    def __init__(self, folder: Path, layout: Layout, alone: Any) -> None:
        self._folder, self._layout, self._alone = folder, layout, alone
        self._spent, self._asked = 0, False
        self.records: Records | None = None
        self.width = 1  # records that go side by side

    def taking(self, records: int, samples: int) -> Records | None:
        """The function that filters a batch in lanes, if there is one."""
        if records < 2:
            return None
        first = self._spent == 0
        self._spent += max(1, records * samples) * self._layout.flops
        worth = self._spent >= WORTH + WORTH_A_STATEMENT * self._layout.statements
        if self.records is None and not self._asked and (first or worth):
            self._asked = worth
            self.records = self._found(build=worth)
        return self.records

    def _found(self, *, build: bool) -> Records | None:
        from fkgen.runtime.compiler import lanes_library  # noqa: PLC0415 - it imports this module

        name = self._layout.name
        source = self._folder / f"{name}_lanes.c"
        library = lanes_library(source, self._layout.statements, build=build)
        try:
            whole = None if library is None else ctypes.CDLL(str(library))
        except OSError:
            return None
        if whole is None or whole[f"{name}_lanes"]() < 2:  # or a processor without vectors
            return None
        self.width = whole[f"{name}_lanes"]()
        return of_records(whole[f"{name}_lanes_records"], self._alone)
