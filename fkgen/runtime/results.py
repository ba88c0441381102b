"""What a filter gives back: `Run` for a record, `Snapshot` for one instance."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError, of_type
from fkgen.runtime import record
from fkgen.runtime.layout import Layout

Array = NDArray[np.floating]


class Run:
    """What a filter said about a record: every kept port is an attribute of shape (T, ...).

    ``run["name"]`` is the same as ``run.name``; ``run.ports`` lists the names. ``status`` is int32:
    0 used, 1 no row present, 2 and 3 rejected by a test for faults, negative refused (the instance
    was unchanged, so ports repeat).
    """

    def __init__(self, values: Mapping[str, Array], status: NDArray[np.int32]) -> None:
        self._values = dict(values)
        self.status = status

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
        if name not in (*self._values, "status"):
            raise DataError("port", given=repr(name), expected=record.choice(name, self.ports))
        return self.status if name == "status" else self._values[name]

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


class Snapshot:
    """The instance after a sample, frozen: every port is an attribute; equal if all bits are."""

    __slots__ = ("_bytes", "_layout", "status")

    def __init__(self, layout: Layout, data: bytes, status: int) -> None:
        self._layout, self._bytes, self.status = layout, data, status

    def __getitem__(self, name: str) -> Array:
        of_type("port", name, str, "the name of a port")
        dtype = np.dtype(self._layout.dtype)
        offset = 0
        for port in self._layout.ports:
            if port.name == name:
                value = port.unpacked(np.frombuffer(self._bytes, dtype, port.size, offset))
                return np.where(self[port.given] > 0, value, np.nan) if port.given else value
            offset += port.size * dtype.itemsize
        names = [port.name for port in self._layout.ports]
        raise DataError("port", given=repr(name), expected=record.choice(name, names))

    def __getattr__(self, name: str) -> Array:
        if name in Snapshot.__slots__:  # not set yet: while being copied
            raise AttributeError(name)
        if any(port.name == name for port in self._layout.ports):
            return self[name]
        raise AttributeError(f"no port {name!r}")

    @property
    def ports(self) -> tuple[str, ...]:
        """Names of the ports."""
        return tuple(port.name for port in self._layout.ports)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Snapshot) and self._bytes == other._bytes

    def __hash__(self) -> int:
        return hash(self._bytes)

    def __repr__(self) -> str:
        return f"<Snapshot of {self._layout.name}: filtered_state {self['filtered_state']}>"
