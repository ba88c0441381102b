"""The log-likelihood of records at many values of parameters at once, in lanes of the filter."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.errors import DataError, StepRefused, of_type
from fkgen.problem import Spec
from fkgen.runtime import record
from fkgen.runtime.compiled import CompiledFilter
from fkgen.runtime.results import Snapshot
from fkgen.runtime.values import headings, place
from fkgen.symbolic.interface import Status

Array = NDArray[np.floating]
Start = Snapshot | Mapping[str, ArrayLike] | None

PORT = "log_likelihood"
#: Numbers of records that are held side by side, where one filter does not need more.
ROOM = 2**23
#: Values of parameters that are tried at a time at least: they fill the lanes.
ABREAST = 16


@dataclass(frozen=True, slots=True, eq=False)
class Records:
    """R records of T samples each.

    Attributes
    ----------
    y : (R, T, p) ndarray
    u : (R, T, q) ndarray
    params : mapping of str to (R, T) or (R, 1) ndarray
        Those that are not estimated.
    start : Snapshot or mapping
        Where all of them begin, or where each does.
    numbers : tuple of int
        Which they are among those that were given.
    """

    y: Array
    u: Array
    params: Mapping[str, Array]
    start: Start
    numbers: tuple[int, ...] = (0,)

    def first(self, samples: int) -> Records:
        """The same records, cut after so many samples."""
        params = {name: values[:, :samples] for name, values in self.params.items()}
        return replace(self, y=self.y[:, :samples], u=self.u[:, :samples], params=params)

    def repeated(self, times: int) -> Records:
        """The same records so many times, one set after the other."""
        y, u = (np.concatenate([values] * times) for values in (self.y, self.u))
        params = {name: np.concatenate([each] * times) for name, each in self.params.items()}
        start = self.start
        if isinstance(start, Mapping):
            start = {key: _repeated(key, value, times) for key, value in start.items()}
        return replace(self, y=y, u=u, params=params, start=start)


def _repeated(key: str, value: ArrayLike, times: int) -> ArrayLike:
    """One prior for all records stays; of one for each there are so many times more."""
    several = np.ndim(value) > (1 if key == "x0" else 2)
    return np.concatenate([np.asarray(value)] * times) if several else value


class Likelihood:
    """log p(y; theta) of a filter, for V vectors theta at a time.

    Parameters
    ----------
    built : CompiledFilter
    names : sequence of str
        The k parameters of theta, in order.
    records : sequence of Records
        All of them are independent.
    """

    def __init__(
        self, built: CompiledFilter, names: Sequence[str], records: Sequence[Records]
    ) -> None:
        self.built, self.names, self.records = built, tuple(names), tuple(records)
        self._repeats: dict[tuple[int, int], Records] = {}

    @property
    def rows(self) -> int:
        """Number of finite rows of y."""
        return sum(int(np.isfinite(each.y).sum()) for each in self.records)

    @property
    def length(self) -> int:
        """Number of samples of all records."""
        return sum(each.y.shape[0] * each.y.shape[1] for each in self.records)

    def first(self, samples: int) -> Likelihood:
        """The same of the first samples of every record, of which all have so many together."""
        each = max(1, samples // sum(len(some.y) for some in self.records))
        return Likelihood(self.built, self.names, [some.first(each) for some in self.records])

    def __call__(self, theta: ArrayLike) -> Array:
        """(V,) for theta (V, k); -inf where the filter refuses a sample."""
        values = np.asarray(theta, float)
        total = np.zeros(len(values))
        for at, found in self._blocks(values):
            total[at] += -np.inf if found is None else found.sum(axis=(1, 2))
        return total

    def samples(self, theta: ArrayLike) -> Array:
        """(V, N): the terms that it is a sum of, N samples of all records."""
        values = np.asarray(theta, float)
        result = np.full((len(values), self.length), np.nan)
        done = dict[int, int]()
        for at, found in self._blocks(values):
            if found is not None:
                flat = found.reshape(len(found), -1)
                start = done.get(at.start, 0)
                result[at, start : start + flat.shape[1]] = flat
                done[at.start] = start + flat.shape[1]
        return result

    def refusal(self, theta: Sequence[float]) -> str:
        """Why the likelihood is not finite there, and at which sample; empty if it is."""
        try:
            for some in self.records:
                run = self._run(some, np.array([theta], float))
                if run.refused.any():
                    m, k = map(int, np.argwhere(run.refused)[0])
                    several = sum(len(each.y) for each in self.records) > 1
                    which = f" of record {some.numbers[m]}" if several else ""
                    return f"sample {k}{which}: {Status(int(run.status[m, k])).meaning}"
        except StepRefused as refused:
            return str(refused)
        return ""

    def _blocks(self, values: Array) -> Iterator[tuple[slice, Array | None]]:
        """Of some of the values, and some of the records: (V, R, T) terms, or None if refused."""
        for number, some in enumerate(self.records):
            size = len(some.y) * some.y.shape[1] * (some.y.shape[2] + some.u.shape[2] + 1)
            most = max(ABREAST, ROOM // max(1, size))
            for begin in range(0, len(values), most):
                part = slice(begin, min(begin + most, len(values)))
                yield from self._block(number, some, values, part)

    def _block(
        self, number: int, some: Records, values: Array, part: slice
    ) -> Iterator[tuple[slice, Array | None]]:
        count, shape = part.stop - part.start, some.y.shape[:2]
        key = (number, count)
        if key not in self._repeats:
            self._repeats = {at: each for at, each in self._repeats.items() if at[0] != number}
            self._repeats[key] = some.repeated(count)
        try:
            run = self._run(self._repeats[key], values[part])
        except StepRefused:  # the prior is none with one of them: which one, each says alone
            if count == 1:
                yield part, None
                return
            for at in range(part.start, part.stop):
                yield from self._block(number, some, values, slice(at, at + 1))
            return
        terms = run[PORT].reshape(count, *shape)
        refused = run.refused.reshape(count, *shape).any(axis=(1, 2))
        terms[refused] = -np.inf
        yield part, terms

    def _run(self, some: Records, values: Array) -> Any:
        """Run the records with every vector; they are repeated already."""
        each = np.repeat(values, len(some.y) // len(values), axis=0)
        own = {name: each[:, j : j + 1] for j, name in enumerate(self.names)}
        u = some.u if self.built.layout.inputs else None
        params = {**some.params, **own}
        return self.built.run_batch(some.y, u, params, keep=[PORT], start=some.start)


def records_of(
    built: CompiledFilter, given: tuple[Any, Any, Any], start: Start, estimated: Sequence[str]
) -> list[Records]:
    """Records as they were ``given`` by y, u and params, those of one length together.

    Raises
    ------
    DataError
        If they do not fit the filter, or hold what is not finite.
    """
    if start is not None and not isinstance(start, Snapshot):
        of_type("start", start, Mapping, "a Snapshot or a mapping with 'x0' and 'P0'")
    taken = [_named(built, name, each, estimated) for name, each in _parted(built, *given)]
    several = len(taken) > 1
    found = []
    for length in dict.fromkeys(len(each.y[0]) for each in taken):
        alike = [m for m, each in enumerate(taken) if len(each.y[0]) == length]
        y_of, u_of = (np.concatenate([getattr(taken[m], n) for m in alike]) for n in ("y", "u"))
        told = {name: [taken[m].params[name] for m in alike] for name in taken[0].params}
        joined = {name: _stacked(values, length) for name, values in told.items()}
        own: Start = start
        if several and isinstance(start, Mapping):
            own = {key: _chosen(key, value, alike, len(taken)) for key, value in start.items()}
        found.append(Records(y_of, u_of, joined, own, tuple(alike)))
    return found


def _stacked(values: Sequence[Array], length: int) -> Array:
    """(R, T), or (R, 1) where no record varies."""
    if all(each.shape[1] == 1 for each in values):
        return np.concatenate(list(values))
    return np.concatenate([np.broadcast_to(each, (1, length)) for each in values])


def _chosen(key: str, value: ArrayLike, alike: Sequence[int], count: int) -> ArrayLike:
    """Of priors for each record those of some."""
    array = np.asarray(value)
    if array.ndim <= (1 if key == "x0" else 2):
        return value
    if len(array) != count:
        raise DataError(f"start.{key}", given=f"{len(array)} priors", expected=f"{count}, as y has")
    return np.ascontiguousarray(array[list(alike)])


def _parted(
    built: CompiledFilter, y: Any, u: Any, params: Any
) -> Iterator[tuple[str, tuple[Any, Any, Any]]]:
    """Name of each record, and its y, u and parameters."""
    parts = _several(y, len(built.layout.outputs))
    if parts is None:
        yield "", (y, u, params)
        return
    inputs = None if u is None else _several(u, len(built.layout.inputs))
    if inputs is not None and len(inputs) != len(parts):
        raise DataError("u", given=f"{len(inputs)} records", expected=f"{len(parts)}, as y has")
    told = params if isinstance(params, list | tuple) else None
    if told is not None and len(told) != len(parts):
        raise DataError("params", given=f"{len(told)} records", expected=f"{len(parts)}, as y has")
    for m, part in enumerate(parts):
        own = told[m] if told is not None else _row(params, m, len(parts))
        yield f"record {m}", (part, u if inputs is None else inputs[m], own)


def _several(value: Any, width: int) -> Sequence[Any] | None:
    """The records of a list of them, or of an array (M, T, w); None if it is one record."""
    if isinstance(value, np.ndarray) and value.ndim == 3:
        return list(value)
    if not isinstance(value, list | tuple) or not value:
        return None
    first = value[0]
    if headings(first) is not None:
        return value
    try:
        axes, size = np.ndim(first), np.size(first)
    except ValueError:  # ragged: `record` says so
        return None
    return value if axes == 2 or (axes == 1 and width == 1 and size > 1) else None


def _row(params: Any, m: int, count: int) -> Any:
    """Parameters of one record: of those with a row for each, its row."""
    if not isinstance(params, Mapping):
        return params
    return {
        name: value[m] if np.ndim(value) == 2 and len(value) == count else value
        for name, value in params.items()
    }


def _named(
    built: CompiledFilter, name: str, given: tuple[Any, Any, Any], estimated: Sequence[str]
) -> Records:
    """One record; errors say which."""
    try:
        return _checked(built, given, estimated)
    except DataError as error:
        if not name:
            raise
        what = f"{name}: {error.what}"
        raise DataError(what, given=error.given, expected=error.expected) from None


def _checked(
    built: CompiledFilter, given: tuple[Any, Any, Any], estimated: Sequence[str]
) -> Records:
    """One record, complete and finite but for missing rows of y."""
    (y, u, params), layout = given, built.layout
    measured = record.measurements(layout, y)
    driven = record.inputs(layout, u, len(measured))
    for each in estimated if isinstance(params, Mapping) else ():
        if each in params:
            expected = "a value of it, or its name in estimate, but not both"
            raise DataError(f"params.{each}", given="a value", expected=expected)
    values = record.values_of(layout.parameters, params, len(measured), layout.dtype)
    told = dict(zip((each for each, _ in layout.parameters), values, strict=True))
    _refuse_infinite("y", measured, layout.outputs, np.isinf(measured))
    _refuse_infinite("u", driven, layout.inputs, ~np.isfinite(driven))
    for each, array in told.items():
        _refuse_infinite(f"params.{each}", array, (), ~np.isfinite(array))
    rest = {each: array[np.newaxis] for each, array in told.items() if each not in estimated}
    return Records(measured[np.newaxis], driven[np.newaxis], rest, None)


def _refuse_infinite(
    what: str, values: Array, names: Sequence[str], wrong: NDArray[np.bool_]
) -> None:
    if wrong.any():
        at = tuple(np.argwhere(wrong)[0].tolist())
        expected = "finite numbers" + (", or NaN where a row is missing" if what == "y" else "")
        raise DataError(place(what, at, names), given=str(values[at]), expected=expected)


def in_double(spec: Spec) -> Spec:
    """The same filter in double, with the port that is needed: differences need the digits."""
    code = spec.code
    if not code.shows(PORT):
        code = replace(code, ports=None)
    return replace(spec, code=replace(code, scalar="double"))
