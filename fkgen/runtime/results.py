"""What a filter gives back: `Run` for a record, `Snapshot` for one instance."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from fkgen.console import html_table
from fkgen.errors import DataError, of_type
from fkgen.problem import Spec
from fkgen.runtime import record
from fkgen.runtime.layout import Layout
from fkgen.symbolic.interface import UPDATED

Array = NDArray[np.floating]

#: Indices of the samples that were not held; inputs and parameters there.
_Kept = NDArray[np.signedinteger]
_Driven = tuple[NDArray[np.float64], NDArray[np.float64]]


class Run:
    """What a filter said about a record: every kept port is an attribute of shape (T, ...).

    ``run["name"]`` is the same as ``run.name``; ``run.ports`` lists the names. ``status`` is int32:
    0 used, 1 no row present, 2 and 3 rejected by a test for faults, negative refused. Time passes
    at a refused sample as if all of y were missing; where it could not, ``held`` is true and the
    ports are those of the sample before.
    """

    def __init__(
        self, values: Mapping[str, Array], status: NDArray[np.int32], held: NDArray[np.bool_]
    ) -> None:
        self._values = dict(values)
        self.status, self.held = status, held

    @classmethod
    def joined(cls, runs: Sequence[Run]) -> Run:
        """Pieces of one record as one."""
        values = {name: np.concatenate([run[name] for run in runs]) for name in runs[0].ports}
        status, held = (np.concatenate([run[name] for run in runs]) for name in ("status", "held"))
        return cls(values, status, held)

    @property
    def ports(self) -> tuple[str, ...]:
        """Names of the ports that were kept."""
        return tuple(self._values)

    @property
    def refused(self) -> NDArray[np.bool_]:
        """(T,) bool: samples that were refused."""
        return np.asarray(self.status < 0)

    def __getitem__(self, name: str) -> NDArray[Any]:
        of_type("port", name, str, "the name of a port")
        if name in {"status", "held"}:
            return np.asarray(getattr(self, name))
        if name not in self._values:
            raise DataError("port", given=repr(name), expected=record.choice(name, self.ports))
        return self._values[name]

    def __getattr__(self, name: str) -> Array:
        values: dict[str, Array] = self.__dict__.get("_values", {})
        if name in values:
            return values[name]
        raise AttributeError(f"no port {name!r} was kept; there are: {', '.join(values)}")

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self._values]

    def __repr__(self) -> str:
        refused = int(np.count_nonzero(self.refused))
        samples = self.status.shape[-1]
        return f"<Run of {samples} samples, {refused} refused: {', '.join(self._values)}>"

    def _repr_html_(self) -> str:
        """Ports and their shapes, for a notebook."""
        rows = ((name, " x ".join(map(str, each.shape))) for name, each in self._values.items())
        caption = repr(self).strip("<>").partition(":")[0]
        return html_table(caption, ("port", "shape"), rows)


#: Names of means and covariances end so.
MOMENTS = "state", "covariance"

#: What a run has to keep to be smoothed.
SMOOTHED_FROM = (
    *("predicted_state", "predicted_covariance", "filtered_state", "filtered_covariance"),
    "innovation",
)

#: The same of a filter over modes, and of one that keeps one Gaussian of all of them.
SMOOTHED_FROM_MODES = ("mode_filtered_state", "mode_filtered_covariance", "mode_probability")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Smoothed:
    """Estimates of a whole record from all of it.

    Attributes
    ----------
    state : (T, n) ndarray
        x(k | T - 1). At a held sample no time passed: it repeats the sample before it.
    covariance : (T, n, n) ndarray
        Its error covariance; an attitude has 3 rows.
    status : (T,) ndarray of int32
        That of the filter: a refused sample counts as missing, but its state is estimated.
    approximate : bool
        The plant is linearised, or mixtures over modes are merged (Kim's smoother), so that these
        are no exact means and covariances.
    """

    state: NDArray[np.float64]
    covariance: NDArray[np.float64]
    status: NDArray[np.int32]
    approximate: bool

    @classmethod
    def of(
        cls, spec: Spec, run: Run, prior: Snapshot, u: Array, parameters: Sequence[Array]
    ) -> Self:
        """Smooth a run that kept what it takes, from the instance that it began with."""
        T, modes = len(run.status), spec.filter.traits.models != "one"
        approximate = modes or spec.filter.linearises
        kept = np.flatnonzero(~run.held)
        state, covariance = (np.array(run[f"filtered_{of}"], float) for of in MOMENTS)
        if not len(kept):
            return cls(
                state=state, covariance=covariance, status=run.status, approximate=approximate
            )
        given = [np.broadcast_to(each.astype(float), (T,)) for each in parameters]
        values = np.array(given, float).reshape(len(given), T)
        driven = np.asarray(u, np.float64)[kept], values.T[kept]
        forwards = (_by_mode if modes else _forwards)(run, kept, prior, driven)
        state, covariance = forwards.backwards(spec)
        last = np.maximum(np.searchsorted(kept, np.arange(T), side="right") - 1, 0)
        return cls(
            state=state[last],
            covariance=covariance[last],
            status=run.status,
            approximate=approximate,
        )

    def __repr__(self) -> str:
        T, n = self.state.shape
        return f"<Smoothed: {T} samples of {n} states{', approximate' * self.approximate}>"


def _forwards(run: Run, kept: _Kept, prior: Snapshot, driven: _Driven) -> Any:
    """What a filter with one mean and one covariance has found at the samples kept."""
    from fkgen.estimators.hindsight.backwards import Forwards  # noqa: PLC0415 - CasADi is slow

    innovation = np.asarray(run["innovation"][kept], float)
    used = np.isfinite(innovation) & (run.status[kept] >= 0)[:, np.newaxis]
    used &= ~run["rejected"][kept] if "rejected" in run.ports else True
    predicted = [
        np.concatenate([start[np.newaxis], run[f"predicted_{of}"][kept[:-1]]]).astype(float)
        for of, start in zip(MOMENTS, prior.latest, strict=True)
    ]
    filtered = [np.array(run[f"filtered_{of}"][kept], float) for of in MOMENTS]
    return Forwards(
        predicted=(predicted[0], predicted[1]),
        filtered=(filtered[0], filtered[1]),
        innovation=np.where(used, innovation, 0.0),
        used=used,
        u=driven[0],
        parameters=driven[1],
    )


def _by_mode(run: Run, kept: _Kept, _: Snapshot, driven: _Driven) -> Any:
    """What a filter has found under each mode, or of all of them in one Gaussian."""
    from fkgen.estimators.hindsight.switched import ForwardsByMode  # noqa: PLC0415 - CasADi is slow

    found = [np.array(run[f"filtered_{of}"][kept], float)[:, None] for of in MOMENTS]
    found.append(np.ones((len(kept), 1)))
    if SMOOTHED_FROM_MODES[0] in run.ports:
        found = [np.array(run[name][kept], float) for name in SMOOTHED_FROM_MODES]
    return ForwardsByMode(
        state=found[0],
        covariance=found[1],
        probability=found[2],
        u=driven[0],
        parameters=driven[1],
    )


class Snapshot:
    """The instance after a sample, frozen: every port is an attribute; equal if all bits are."""

    __slots__ = ("data", "layout", "status", "y")

    def __init__(self, layout: Layout, data: bytes, status: int, y: bytes = b"") -> None:
        self.layout, self.data, self.status = layout, data, status
        self.y = y  # Of the last update; empty: there was none

    def __getitem__(self, name: str) -> NDArray[Any]:
        of_type("port", name, str, "the name of a port")
        dtype = np.dtype(self.layout.dtype)
        offset = 0
        for port in self.layout.ports:
            if port.name == name:
                value = port.unpacked(np.frombuffer(self.data, dtype, port.size, offset))
                if port.flags:
                    return value > 0
                if port.per_row:
                    value = np.where(self._absent(value == 0), np.nan, value)
                return np.where(self[port.given] > 0, value, np.nan) if port.given else value
            offset += port.size * dtype.itemsize
        names = [port.name for port in self.layout.ports]
        raise DataError("port", given=repr(name), expected=record.choice(name, names))

    def _absent(self, silent: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Rows that the last update did not have: missing, or out of their range and so silent."""
        if not self.y:
            return np.ones_like(silent)
        missing = np.isnan(np.frombuffer(self.y, self.layout.dtype))
        return missing | (silent & self["rejected"] if "rejected" in self.ports else False)

    def __getattr__(self, name: str) -> Array:
        if name in Snapshot.__slots__:  # not set yet: while being copied
            raise AttributeError(name)
        if any(port.name == name for port in self.layout.ports):
            return self[name]
        raise AttributeError(f"no port {name!r}")

    @property
    def latest(self) -> tuple[Array, Array]:
        """The latest estimate and its covariance: filtered after an update, else predicted."""
        updated = getattr(self.layout.structure().from_buffer_copy(self.data), UPDATED)
        of = "filtered_" if updated else "predicted_"
        return self[f"{of}state"], self[f"{of}covariance"]

    @property
    def ports(self) -> tuple[str, ...]:
        """Names of the ports."""
        return tuple(port.name for port in self.layout.ports)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Snapshot) or self.data != other.data:
            return False
        return self.layout == other.layout

    def __hash__(self) -> int:
        return hash(self.data)

    def __repr__(self) -> str:
        return f"<Snapshot of {self.layout.name}: filtered_state {self['filtered_state']}>"
