"""`CompiledFilter`: generated C behind NumPy arrays. A whole record is one call."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.console import Advance
from fkgen.errors import DataError, InternalError, StepRefused, of_type
from fkgen.runtime import cache, record
from fkgen.runtime.blocks import in_blocks
from fkgen.runtime.layout import Layout
from fkgen.runtime.results import Run, Snapshot
from fkgen.symbolic.interface import Status

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

    def __init__(self, entry: Path) -> None:
        layout = Layout.from_json((entry / cache.LAYOUT).read_text(encoding="utf-8"))
        self.layout, self.folder = layout, entry
        self.name, self.family, self.scalar = layout.name, layout.family, layout.scalar
        self.ports = tuple(port.name for port in layout.ports)
        self.claims = layout.claims
        self._library = ctypes.CDLL(str(entry / cache.LIBRARY))
        self._record = self._library[f"{layout.name}_record"]
        self._record.argtypes = [ctypes.c_void_p, ctypes.c_int64, *[ctypes.c_void_p] * 6]
        self._record.restype = None
        self._init = self._library[f"{layout.name}_record_init"]
        self._init.argtypes = [ctypes.c_void_p]
        self._type = layout.structure()
        if self._library[f"{layout.name}_record_size"]() != ctypes.sizeof(self._type):
            raise InternalError(f"{layout.name}: the C instance has another size than its layout")
        self._dtype = layout.dtype
        self._instance = self._type()
        # Buffers and pointers that stay where they are, so that a step costs one call.
        self._y = np.zeros(len(layout.outputs), self._dtype)
        self._u = np.zeros(len(layout.inputs), self._dtype)
        self._parameters = [np.zeros(1, self._dtype) for _ in layout.parameters]
        self._status = np.zeros(1, np.int32)
        nothing = Run({}, self._status)
        data = (self._y[np.newaxis], self._u[np.newaxis])
        self._alive = self._arguments(self._instance, data, self._parameters, nothing)
        self._step_arguments = tuple(
            ctypes.addressof(each) if isinstance(each, ctypes.Array) else each
            for each in self._alive
        )
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
        given = record.values_of(self.layout.parameters, params, len(measured), self._dtype)
        found = self._room((len(measured),), keep)
        self._filter((measured, driven), given, found)
        return found

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
        given = record.values_of(
            self.layout.parameters, params, shape[1], self._dtype, records=shape[0]
        )
        found = self._room(shape, keep)

        def work(start: int, stop: int) -> None:
            for m in range(start, stop):
                each = driven[m] if driven is not None and driven.ndim == 3 else driven
                ready = record.inputs(self.layout, each, shape[1])
                told = [p[m] if p.ndim == 2 else p for p in given]
                part = Run({name: found[name][m] for name in found}, found.status[m])
                self._filter((records[m], ready), told, part)

        in_blocks(work, shape[0], max(1, BLOCK // max(1, shape[1])), advance)
        return found

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
        of_type("port", name, str, "the name of a port")
        if name not in self.ports:
            raise DataError("port", given=repr(name), expected=record.choice(name, self.ports))
        field = getattr(self._type, name)
        view: Array = np.frombuffer(memoryview(self._instance), self._dtype)
        size = np.dtype(self._dtype).itemsize
        return view[field.offset // size : (field.offset + field.size) // size]

    def __repr__(self) -> str:
        wide = f"{len(self.layout.states)} states, {len(self.layout.outputs)} measurements"
        return f"<CompiledFilter {self.name}: {self.family}, {wide}, {self.scalar}>"

    def _room(self, shape: tuple[int, ...], keep: Sequence[str] | None) -> Run:
        ports = record.kept(self.layout, keep)
        values = {port.name: np.empty((*shape, *port.shape), self._dtype) for port in ports}
        return Run(values, np.empty(shape, np.int32))

    def _filter(self, data: tuple[Array, Array], parameters: list[Array], found: Run) -> None:
        """Filter y and u from the prior."""
        instance = self._type()
        self._init(ctypes.addressof(instance))
        self._record(*self._arguments(instance, data, parameters, found))

    def _arguments(
        self,
        instance: ctypes.Structure,
        data: tuple[Array, Array],
        parameters: list[Array],
        found: Run,
    ) -> tuple[Any, ...]:
        """What C takes: arrays of pointers, and addresses in arrays that have to live on."""
        count = max(1, len(parameters))
        out = [found[p.name].ctypes.data if p.name in found else None for p in self.layout.ports]
        return (
            ctypes.addressof(instance),
            len(data[0]),
            (ctypes.c_void_p * count)(*[values.ctypes.data for values in parameters]),
            (ctypes.c_int64 * count)(*[values.size > 1 for values in parameters]),
            data[1].ctypes.data,
            data[0].ctypes.data,
            (ctypes.c_void_p * len(out))(*out),
            found.status.ctypes.data,
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
        values = record.values_of(self.layout.parameters, given, 1, self._dtype)
        for place, value in zip(self._parameters, values, strict=True):
            place[:] = value
