"""`CompiledFilter`: generated C behind NumPy arrays. A whole record is one call."""

from __future__ import annotations

import ctypes
import json
import math
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.console import Advance
from fkgen.errors import DataError, InternalError, StepRefused, of_type
from fkgen.problem import Spec
from fkgen.runtime import cache, record
from fkgen.runtime.batch import Batch, Lanes, of_records
from fkgen.runtime.blocks import in_blocks
from fkgen.runtime.layout import Layout
from fkgen.runtime.results import SMOOTHED_FROM, SMOOTHED_FROM_MODES, Run, Smoothed, Snapshot
from fkgen.runtime.start import own_bytes, priors
from fkgen.symbolic.interface import Status

Array = NDArray[np.floating]

_NUMBERS = frozenset((float, int))

#: Refusals of which equations may be the reason.
_EXPLAINED = frozenset((Status.RESULT_NOT_FINITE, Status.NOT_POSITIVE_DEFINITE))

#: Samples that one thread filters at a stretch.
BLOCK = 50_000


@dataclass(frozen=True, slots=True)
class Pieces:
    """A record in pieces."""

    filter: Callable[[ArrayLike, ArrayLike | None, Mapping[str, ArrayLike] | None], Run]
    #: Which equation is why sample k of the latest piece was refused; empty if none is
    reason: Callable[[int], str]


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
        path, pointer = str(entry / cache.LIBRARY), ctypes.c_void_p
        whole, short = ctypes.CDLL(path), ctypes.PyDLL(path)  # a short call keeps Python's lock
        self._records = of_records(whole[f"{layout.name}_call_records"])
        alone = ctypes.cast(whole[f"{layout.name}_call_alone"], pointer)
        found = [short[f"{layout.name}_call_{name}"] for name in ("step", "update", "predict")]
        self._step, self._update, self._predict = found
        self._begin = whole[f"{layout.name}_call_starts"]
        self._begin.argtypes = tuple(c for _ in range(4) for c in (pointer, ctypes.c_int64))
        self._lanes = Lanes(entry, layout, alone)
        self._type = layout.structure()
        if short[f"{layout.name}_record_size"]() != ctypes.sizeof(self._type):
            raise InternalError(f"{layout.name}: the C instance has another size than its layout")
        self._dtype = layout.dtype
        self._largest, self._defaults = float(np.finfo(layout.dtype).max), dict(layout.parameters)
        self._prepare()
        self.reset()

    def _prepare(self) -> None:
        """An instance, and what its calls are given, which stays where it is."""
        layout, real = self.layout, self.layout.real
        self._instance = self._type()
        self._image = np.frombuffer(memoryview(self._instance), np.uint8).tobytes
        self._y = (real * len(layout.outputs))()
        self._u = (real * len(layout.inputs))()
        self._parameters = (real * len(layout.parameters))()
        self._place_parameters({})
        self._driven = bool(layout.inputs)
        self._call = ctypes.byref(self._given(self._instance, self._parameters))

    def _given(self, instance: Any, parameters: Any) -> Any:
        """What one call is given: the addresses of four objects that live as long as it does."""
        given: Any = (instance, parameters, self._u, self._y)
        places: Any = (ctypes.c_void_p * 4)(*map(ctypes.addressof, given))
        places.given = given
        return places

    def run(
        self,
        y: ArrayLike,
        u: ArrayLike | None = None,
        params: Mapping[str, ArrayLike] | None = None,
        *,
        keep: Sequence[str] | None = None,
        start: Snapshot | Mapping[str, ArrayLike] | None = None,
    ) -> Run:
        """Filter a whole record in C; the instance of `step` is not touched.

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
        start : Snapshot or mapping
            Where to go on, or the prior of sample 0 as ``{"x0": (n,), "P0": (n, n)}``; what is left
            out is that of the spec.

        Returns
        -------
        Run

        Raises
        ------
        DataError
            If shapes, types or names do not fit. Samples that C refuses have a negative ``status``.
        """
        measured = record.measurements(self.layout, y)
        driven = record.inputs(self.layout, u, len(measured))
        given = record.values_of(self.layout.parameters, params, len(measured), self._dtype)
        found = self._room((len(measured),), keep)
        self._filter(self._starts(start, given), (measured, driven), given, found)
        return found

    def smooth(
        self,
        y: ArrayLike,
        u: ArrayLike | None = None,
        params: Mapping[str, ArrayLike] | None = None,
        *,
        start: Snapshot | Mapping[str, ArrayLike] | None = None,
    ) -> Smoothed:
        """Estimate every sample of a record from all of it: filter in C, then go back through it.

        Parameters are those of `run`.

        Returns
        -------
        Smoothed

        Raises
        ------
        DataError
            If shapes, types or names do not fit, or the family has no smoother.
        """
        spec = self._smoothable()
        measured = record.measurements(self.layout, y)
        driven = record.inputs(self.layout, u, len(measured))
        given = record.values_of(self.layout.parameters, params, len(measured), self._dtype)
        rejected = tuple(port.name for port in self.layout.ports if port.flags)
        _refuse_late(
            spec, dict(zip((name for name, _ in self.layout.parameters), given, strict=True))
        )
        own = SMOOTHED_FROM_MODES if spec.filter.traits.models == "mixed" else ()
        found = self._room((len(measured),), (*SMOOTHED_FROM, *own, *rejected))
        begun = self._starts(start, given)
        prior = Snapshot(self.layout, bytes(begun[0]), 0)
        self._filter(begun, (measured, driven), given, found)
        return Smoothed.of(spec, found, prior, driven, given)

    def _smoothable(self) -> Spec:
        """The spec, if its family has a smoother."""
        from fkgen.families import NAMES, family  # noqa: PLC0415 - few filters are smoothed

        text = (self.folder / cache.SPEC).read_text(encoding="utf-8")
        spec = Spec.from_dict(json.loads(text)["spec"])
        if spec.filter.traits.smooths:
            jump = spec.faults.jump
            if spec.filter.traits.hindsight or not (
                spec.filter.linearises or (jump and jump.unequal)
            ):
                return spec
            given = f"modes with f and h, or of unequal size, of the family {spec.filter.family}"
            raise DataError("smooth", given=given, expected="modes with matrices of one size")
        able = ", ".join(name for name in NAMES if family(name).traits.smooths)
        gain = " with a stationary gain" * family(spec.filter.family).traits.hindsight
        given = f"a filter of the family {spec.filter.family}{gain}"
        expected = f"one of {able}, its gain not stationary"
        if spec.filter.traits.windows == "full":
            rows = "NaN for rows of windows that were rejected: docs/smooth.md"
            expected = f"a filter of the family kf of its plant, and {rows}"
        raise DataError("smooth", given=given, expected=expected)

    def pieces(self, keep: Sequence[str] | None = None) -> Pieces:
        """What filters a record piece by piece, as `run` the whole of it."""
        latest: list[NDArray[np.uint8]] = []
        before: list[Any] = []

        def piece(y: ArrayLike, u: ArrayLike | None, params: Mapping[str, ArrayLike] | None) -> Run:
            measured = record.measurements(self.layout, y)
            driven = record.inputs(self.layout, u, len(measured))
            given = record.values_of(self.layout.parameters, params, len(measured), self._dtype)
            found = self._room((len(measured),), keep)
            if not latest:
                latest.append(self._starts(None, given))
            before[:] = latest[0].copy(), (measured, driven), given, found.status
            self._filter(latest[0], (measured, driven), given, found)
            return found

        def reason(k: int) -> str:
            start, (y, u), given, status = before
            if Status(int(status[k])) not in _EXPLAINED:
                return ""
            earlier = [values[:k] if values.size > 1 else values for values in given]
            self._filter(start, (y[:k], u[:k]), earlier, self._room((k,), ()))
            now = (float(values[k if values.size > 1 else 0]) for values in given)
            names = (name for name, _ in self.layout.parameters)
            other = copy(self)
            other.restore(Snapshot(self.layout, bytes(start[0]), 0))
            try:
                other.step(y[k], u[k] if self._driven else None, dict(zip(names, now, strict=True)))
            except StepRefused as refused:
                return refused.reason
            return ""

        return Pieces(piece, reason)

    def run_batch(
        self,
        y: ArrayLike,
        u: ArrayLike | None = None,
        params: Mapping[str, ArrayLike] | None = None,
        *,
        keep: Sequence[str] | None = None,
        start: Snapshot | Mapping[str, ArrayLike] | None = None,
        advance: Advance | None = None,
    ) -> Run:
        """Filter M independent records on all cores.

        Parameters
        ----------
        y : (M, T, p) array_like
        u : (M, T, q) or (T, q) array_like
            Inputs of each record, or of all of them.
        params : mapping of str to float, (T,), (M, T) or (M, 1) array_like
            As for `run`, the same for all records, or one row, or one number, per record.
        keep : sequence of str
            Ports to store; all by default.
        start : Snapshot or mapping
            As for `run`; ``x0`` may be (M, n) and ``P0`` (M, n, n), one for each record.
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
        starts = self._starts(start, given, shape[0])
        batch = self._batch(starts, (records, driven), given, found)
        filtered = self._lanes.taking(*shape) or self._records
        width = self._lanes.width
        size = width * max(1, BLOCK // (width * max(1, shape[1])))
        in_blocks(lambda *some: filtered(batch, *some), shape[0], size, advance)
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
        self._place("y", y, self._y)
        if self._driven or u is not None or params is not None or self._varied:
            self._drive(u, params)
        status = self._step(self._call)
        if status >= 0:
            self._taken = bytes(self._y)
            return Snapshot(self.layout, self._image(), status, self._taken)
        return self._refuse(status, "hf")

    def update(
        self,
        y: ArrayLike,
        u: ArrayLike | None = None,
        params: Mapping[str, float] | None = None,
    ) -> Snapshot:
        """Correct the latest estimate with a sample; several in a row are several sensors.

        Parameters and errors are those of `step`. A filter that can take one update per sample
        refuses the second one.
        """
        self._place("y", y, self._y)
        if self._driven or u is not None or params is not None or self._varied:
            self._drive(u, params)
        status = self._update(self._call)
        if status >= 0:
            self._taken = bytes(self._y)
            return Snapshot(self.layout, self._image(), status, self._taken)
        return self._refuse(status, "h")

    def predict(
        self, u: ArrayLike | None = None, params: Mapping[str, float] | None = None
    ) -> Snapshot:
        """Move the latest estimate to the next sample; after a prediction, without a measurement.

        Parameters and errors are those of `step`.
        """
        if self._driven or u is not None or params is not None or self._varied:
            self._drive(u, params)
        status = self._predict(self._call)
        if status >= 0:
            return Snapshot(self.layout, self._image(), status, self._taken)
        return self._refuse(status, "f")

    def reset(
        self,
        x0: ArrayLike | None = None,
        P0: ArrayLike | None = None,
        params: Mapping[str, float] | None = None,
    ) -> None:
        """Return the instance to a prior, by default to that of the spec.

        Raises
        ------
        DataError
            If a shape is wrong or P0 is no covariance.
        StepRefused
            If C refuses the prior; the instance is unchanged.
        """
        given = {name: value for name, value in (("x0", x0), ("P0", P0)) if value is not None}
        told = record.values_of(self.layout.parameters, params, 1, self._dtype)
        data = self._starts(given, told)
        ctypes.memmove(ctypes.addressof(self._instance), data.ctypes.data, data.size)
        self._taken = b""
        self._place_parameters({})

    def restore(self, snapshot: Snapshot) -> None:
        """Return the instance to where a snapshot of the same filter was taken.

        Raises
        ------
        DataError
            If it is the snapshot of another filter.
        """
        data = own_bytes(self.layout, snapshot)
        ctypes.memmove(ctypes.addressof(self._instance), data, len(data))
        self._taken = snapshot.y

    def snapshot(self) -> Snapshot:
        """The instance as it is now."""
        return Snapshot(self.layout, self._image(), 0, self._taken)

    def __copy__(self) -> CompiledFilter:
        """A filter with an instance of its own, where this one is."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__)
        other._prepare()
        other.restore(self.snapshot())
        return other

    def __deepcopy__(self, _: object) -> CompiledFilter:
        """The same: nothing but the library is shared, and nothing changes that."""
        return self.__copy__()

    def __reduce__(self) -> tuple[Any, ...]:
        """Rebuild from the cache, or from the generated C where that is gone, and restore."""
        from fkgen.runtime.compiler import revived  # noqa: PLC0415 - it imports this module

        files = self.folder.glob("*.[chj]*")
        texts = {path.name: path.read_text(encoding="utf-8") for path in files}
        return revived, (self.folder.name, texts, cache.processor(), self.snapshot())

    def state(self, name: str) -> Array:
        """Writable view of one stored member of the instance, packed as in C."""
        of_type("port", name, str, "the name of a port")
        if name not in self.ports:
            raise DataError("port", given=repr(name), expected=record.choice(name, self.ports))
        field = getattr(self._type, next(p.member for p in self.layout.ports if p.name == name))
        view: Array = np.frombuffer(memoryview(self._instance), self._dtype)
        size = np.dtype(self._dtype).itemsize
        return view[field.offset // size : (field.offset + field.size) // size]

    def __repr__(self) -> str:
        wide = f"{len(self.layout.states)} states, {len(self.layout.outputs)} measurements"
        return f"<CompiledFilter {self.name}: {self.family}, {wide}, {self.scalar}>"

    def _room(self, shape: tuple[int, ...], keep: Sequence[str] | None) -> Run:
        ports = record.kept(self.layout, keep)
        cells = sum(math.prod(p.shape) * np.dtype(self.layout.dtype_of(p)).itemsize for p in ports)
        size = math.prod(shape) * (cells + np.dtype(np.int32).itemsize + 1)
        what = " x ".join(map(str, shape))
        record.afford("keep", f"{len(ports)} ports of {what} samples: {size / 2**30:.3g} GiB", size)
        values = {
            port.name: np.empty((*shape, *port.shape), self.layout.dtype_of(port)) for port in ports
        }
        return Run(values, np.zeros(shape, np.int32), np.zeros(shape, np.bool_))

    def _starts(
        self,
        start: Snapshot | Mapping[str, ArrayLike] | None,
        parameters: list[Array],
        records: int | None = None,
    ) -> NDArray[np.uint8]:
        """Instances to start from, (1, bytes), or (M, bytes) with one for each record."""
        if isinstance(start, Snapshot):
            return np.frombuffer(bytearray(own_bytes(self.layout, start)), np.uint8)[np.newaxis]
        prior = priors(self.layout, {} if start is None else start, records)
        rows = [np.atleast_2d(values) for values in parameters]
        rows = [
            row if row.shape[1] else np.array([[default]], self._dtype)
            for row, (_, default) in zip(rows, self.layout.parameters, strict=True)
        ]
        count = max(len(each) for each in (*rows, *prior, (1,)) if each is not None)
        instances = np.empty((count, ctypes.sizeof(self._type)), np.uint8)
        steps = np.array([row.shape[1] if len(row) > 1 else 0 for row in rows], np.int64)
        places = np.array([row.ctypes.data for row in rows], np.uintp)
        given: list[int | None] = []
        for each in prior:
            given += (
                [None, 0] if each is None else [each.ctypes.data, len(each) > 1 and each[0].size]
            )
        at = instances.ctypes.data
        self._accepted(self._begin(at, count, places.ctypes.data, steps.ctypes.data, *given))
        return instances

    def _accepted(self, status: int) -> None:
        if status < 0:
            self._refuse(status)

    def _filter(
        self,
        starts: NDArray[np.uint8],
        data: tuple[Array, Array],
        parameters: list[Array],
        found: Run,
    ) -> None:
        """Filter y and u; the instance moves on."""
        self._records(self._batch(starts, (data[0][np.newaxis], data[1]), parameters, found), 0, 1)

    def _batch(
        self,
        starts: NDArray[np.uint8],
        data: tuple[Array, Array],
        parameters: list[Array],
        found: Run,
    ) -> Batch:
        """What C is given of records and of the places of results."""
        wanted = {name: found[name] for name in found.ports}
        out = [wanted.get(port.name) for port in self.layout.ports]
        return Batch.of(starts, data, parameters, (out, found.status, found.held))

    def _refuse(self, status: int, parts: str = "") -> NoReturn:
        found, reason = Status(status), self._reason(status, parts)
        raise StepRefused(status, f"{self.name.upper()}_{found.name}", found.meaning, reason)

    def _reason(self, status: int, parts: str) -> str:
        """Which equation is why the last call was refused, which was about "h", "f" or both."""
        path, at = self.folder / cache.SPEC, self.snapshot()
        if Status(status) not in _EXPLAINED or not path.is_file():
            return ""
        from fkgen.runtime.refusals import reason  # noqa: PLC0415 - needed for refusals alone

        given = list(self._u), list(self._parameters)
        if "h" in parts and (found := reason(path, at, "h", *given)):
            return found
        if "h" in parts and "f" in parts:  # it is about f only if y was taken in before
            instance = self._type.from_buffer_copy(at.data)
            if self._update(ctypes.byref(self._given(instance, self._parameters))) < 0:
                return ""
            at = Snapshot(self.layout, bytes(instance), 0)
        return reason(path, at, "f", *given) if "f" in parts else ""

    def _drive(self, u: ArrayLike | None, params: Mapping[str, float] | None) -> None:
        """Put inputs and parameters where C reads them."""
        if self._driven or u is not None:
            self._place("u", u, self._u)
        if params is not None or self._varied:
            self._place_parameters(params or {})

    def _place(self, what: str, value: Any, place: Any) -> None:
        """Put a sample where C reads it; plain numbers in the right shape without a detour."""
        kind = type(value)
        if kind is np.ndarray:
            quick = value.dtype.kind in "fiu"
        else:
            quick = (kind is list or kind is tuple) and _NUMBERS.issuperset(map(type, value))
        if quick:
            try:
                place[:] = value.tolist() if kind is np.ndarray else value
            except (TypeError, ValueError, OverflowError):
                pass  # it has another shape: below
            else:
                return
        names = self.layout.outputs if what == "y" else self.layout.inputs
        place[:] = record.sample(what, value, names, self._dtype).tolist()

    def _place_parameters(self, given: Mapping[str, float]) -> None:
        """Parameters of this sample; those not given take their defaults."""
        self._varied = bool(given)
        if type(given) is dict and self._defaults.keys() >= given.keys():
            values = [*(self._defaults | given).values()]
            if _NUMBERS.issuperset(map(type, values)) and all(map(self._in_range, values)):
                self._parameters[:] = values  # the fast way: nothing to convert
                return
        arrays = record.values_of(self.layout.parameters, given, 1, self._dtype)
        self._parameters[:] = [value[0] for value in arrays]

    def _in_range(self, value: float) -> bool:
        """Whether it is a finite number of the filter's scalar."""
        return -self._largest <= value <= self._largest


def _refuse_late(spec: Spec, parameters: Mapping[str, Array]) -> None:
    """Refuse to smooth rows where they come and not where they were measured."""
    for signal in spec.model.outputs:
        if signal.max_delay and (parameters[signal.delay] > 0.0).any():
            expected = "0: with the whole record at hand, put rows where they were measured"
            raise DataError(
                f"params.{signal.delay}", given="rows that come late", expected=expected
            )
