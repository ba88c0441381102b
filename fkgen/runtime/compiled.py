"""`CompiledFilter`: generated C behind NumPy arrays. A whole record is one call."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.console import Advance
from fkgen.errors import DataError, InternalError, StepRefused
from fkgen.runtime import record
from fkgen.runtime.blocks import in_blocks
from fkgen.runtime.layout import Layout
from fkgen.runtime.results import Run, Snapshot
from fkgen.symbolic.interface import Port, Status

Array = NDArray[np.floating]

#: Samples that one thread filters at a stretch.
BLOCK = 50_000


class CompiledFilter:
    """A compiled filter: `run` a record, or `step` one instance sample by sample.

    Attributes
    ----------
    name, family, scalar : str
    ports : tuple of str
        Names of everything that a run can return.
    claims : tuple of str
        What was proved before the code was generated.
    folder : Path
        Where the generated files lie beside the library.
    """

    def __init__(self, layout: Layout, library: Path) -> None:
        self.layout, self.folder = layout, library.parent
        self.name, self.family, self.scalar = layout.name, layout.family, layout.scalar
        self.ports = tuple(port.name for port in layout.ports)
        self.claims = layout.claims
        self._library = ctypes.CDLL(str(library))
        self._record = self._library[f"{layout.name}_record"]
        self._record.argtypes = [ctypes.c_void_p, ctypes.c_int64, *[ctypes.c_void_p] * 6]
        self._record.restype = None
        self._init = self._library[f"{layout.name}_record_init"]
        self._init.argtypes = [ctypes.c_void_p]
        self._type = layout.structure()
        if self._library[f"{layout.name}_record_size"]() != ctypes.sizeof(self._type):
            raise InternalError(f"{layout.name}: the C instance has another size than its layout")
        self._dtype = record.dtype_of(layout)
        self._instance = self._type()
        self._prepare_step()
        self.reset()

    def run(
        self,
        y: ArrayLike,
        u: ArrayLike | None = None,
        params: Mapping[str, ArrayLike] | None = None,
        *,
        keep: Sequence[str] | None = None,
    ) -> Run:
        """Filter a whole record in C, from the prior; the instance of `step` is not touched.

        Parameters
        ----------
        y : (T, p) array_like
            Measurements; NaN = missing. (T,) if p = 1.
        u : (T, q) array_like
            Inputs, if the model has any. (T,) if q = 1.
        params : mapping of str to float or (T,) array_like
            Run-time parameters; those left out keep their defaults.
        keep : sequence of str
            Ports to store; all by default.

        Returns
        -------
        Run

        Raises
        ------
        DataError
            If shapes, types or names do not fit. Samples that C refuses have a negative ``status``.
        """
        measured = record.signal("y", y, len(self.layout.outputs), self._dtype)
        driven = record.inputs(self.layout, u, len(measured))
        given = record.parameters(self.layout, params, len(measured))
        ports = self._kept(keep)
        values = {port.name: np.empty((len(measured), *port.shape), self._dtype) for port in ports}
        status = np.empty(len(measured), np.int32)
        self._filter(measured, driven, given, values, status)
        return Run(values, status)

    def run_batch(
        self,
        y: ArrayLike,
        u: ArrayLike | None = None,
        params: Mapping[str, ArrayLike] | None = None,
        *,
        keep: Sequence[str] | None = None,
        advance: Advance | None = None,
    ) -> Run:
        """Filter M independent records, each from the prior, on all cores.

        Parameters
        ----------
        y : (M, T, p) array_like
        u : (M, T, q) or (T, q) array_like
            Inputs of each record, or of all of them.
        params : mapping of str to float, (T,) or (M, T) array_like
            As for `run`, the same for all records, or one row per record.
        keep : sequence of str
            Ports to store; all by default.
        advance : callable, optional
            Called with the number of records that were finished since the last call.

        Returns
        -------
        Run
            Ports of shape (M, T, ...), status (M, T).
        """
        records, driven = record.batch(self.layout, y, u)
        shape = records.shape[:2]
        given = record.parameters(self.layout, params, shape[1], records=shape[0])
        ports = self._kept(keep)
        values = {port.name: np.empty((*shape, *port.shape), self._dtype) for port in ports}
        status = np.empty(shape, np.int32)

        def work(start: int, stop: int) -> None:
            for m in range(start, stop):
                each = driven[m] if driven is not None and driven.ndim == 3 else driven
                ready = record.inputs(self.layout, each, shape[1])
                told = [p[m] if p.ndim == 2 else p for p in given]
                self._filter(
                    records[m], ready, told, {n: v[m] for n, v in values.items()}, status[m]
                )

        in_blocks(work, shape[0], max(1, BLOCK // max(1, shape[1])), advance)
        return Run(values, status)

    def step(
        self,
        y: ArrayLike,
        u: ArrayLike | None = None,
        params: Mapping[str, float] | None = None,
    ) -> Snapshot:
        """Update the instance with one sample, predict the next, and return what it says.

        Parameters
        ----------
        y : (p,) array_like
            NaN = missing; a number if p = 1.
        u : (q,) array_like
            If the model has inputs.
        params : mapping of str to float
            Parameters of this sample; those left out take their defaults.

        Raises
        ------
        StepRefused
            If C returns a negative status; the instance is unchanged.
        DataError
            If shapes or names do not fit.
        """
        if type(y) is np.ndarray and y.dtype is self._y.dtype and y.shape == self._y.shape:
            self._y[:] = y  # the fast way: nothing to check
        else:
            self._place("y", y, self._y)
        if type(u) is np.ndarray and u.dtype is self._u.dtype and u.shape == self._u.shape:
            self._u[:] = u
        elif u is not None or self._u.size:
            self._place("u", u, self._u)
        if params is not None or self._varied:
            self._place_parameters(params or {})
        self._record(*self._step_arguments)
        status = int(self._status[0])
        if status < 0:
            found = Status(status)
            raise StepRefused(status, f"{self.name.upper()}_{found.name}", found.meaning)
        return Snapshot(self.layout, bytes(self._instance), status)

    def reset(self) -> None:
        """Return the instance to the prior, and parameters to their defaults."""
        self._init(ctypes.addressof(self._instance))
        self._place_parameters({})

    def snapshot(self) -> Snapshot:
        """The instance as it is now."""
        return Snapshot(self.layout, bytes(self._instance), 0)

    def state(self, name: str) -> Array:
        """Writable view of one stored member of the instance, packed as in C."""
        if name not in self.ports:
            raise DataError("port", given=repr(name), expected=record.choice(name, self.ports))
        field = getattr(self._type, name)
        view: Array = np.frombuffer(memoryview(self._instance), self._dtype)
        size = np.dtype(self._dtype).itemsize
        return view[field.offset // size : (field.offset + field.size) // size]

    def __repr__(self) -> str:
        wide = f"{len(self.layout.states)} states, {len(self.layout.outputs)} measurements"
        return f"<CompiledFilter {self.name}: {self.family}, {wide}, {self.scalar}>"

    def _kept(self, keep: Sequence[str] | None) -> list[Port]:
        names = record.kept(self.layout, keep)
        return [port for port in self.layout.ports if port.name in names]

    def _filter(
        self,
        y: Array,
        u: Array,
        parameters: list[Array],
        values: Mapping[str, Array],
        status: NDArray[np.int32],
    ) -> None:
        instance = self._type()
        self._init(ctypes.addressof(instance))
        pointers = (ctypes.c_void_p * max(1, len(parameters)))(*[p.ctypes.data for p in parameters])
        strides = np.array([int(p.size > 1) for p in parameters] or [0], np.int64)
        out = [values[p.name].ctypes.data if p.name in values else None for p in self.layout.ports]
        places = (ctypes.c_void_p * len(out))(*out)
        self._record(
            ctypes.addressof(instance),
            len(y),
            pointers,
            strides.ctypes.data,
            u.ctypes.data,
            y.ctypes.data,
            places,
            status.ctypes.data,
        )

    def _prepare_step(self) -> None:
        """Buffers and pointers that stay where they are, so that a step costs one call."""
        self._y = np.zeros(len(self.layout.outputs), self._dtype)
        self._u = np.zeros(len(self.layout.inputs), self._dtype)
        self._parameters = {n: np.zeros(1, self._dtype) for n, _ in self.layout.parameters}
        self._varied = False
        self._status = (ctypes.c_int32 * 1)()
        pointers: Any = ctypes.c_void_p * max(1, len(self._parameters))
        self._pointers = pointers(*[p.ctypes.data for p in self._parameters.values()])
        self._strides = (ctypes.c_int64 * max(1, len(self._parameters)))()
        self._nothing = (ctypes.c_void_p * len(self.layout.ports))()
        self._step_arguments = (
            ctypes.addressof(self._instance),
            1,
            ctypes.addressof(self._pointers),
            ctypes.addressof(self._strides),
            self._u.ctypes.data,
            self._y.ctypes.data,
            ctypes.addressof(self._nothing),
            ctypes.addressof(self._status),
        )

    def _place(self, what: str, value: ArrayLike | None, place: Array) -> None:
        """Copy one sample to where C reads it; a number will do for a single row."""
        if value is None:
            raise DataError(what, given="nothing", expected=f"numbers of shape {place.shape}")
        try:
            sample = np.asarray(value, self._dtype)
        except (TypeError, ValueError):
            raise DataError(what, given=repr(value), expected="real numbers") from None
        if sample.shape != place.shape and (sample.ndim or place.size != 1):
            raise DataError(what, given=f"shape {sample.shape}", expected=f"shape {place.shape}")
        place[:] = sample

    def _place_parameters(self, given: Mapping[str, float]) -> None:
        """Parameters of this sample; those not given take their defaults."""
        self._varied = bool(given)
        values = record.parameters(self.layout, given, 1)
        for place, value in zip(self._parameters.values(), values, strict=True):
            place[:] = value
