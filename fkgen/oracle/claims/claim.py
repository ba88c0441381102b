"""A claim: what an oracle says of a spec and a record, and how far a recursion may be from it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from fkgen.oracle.plants.equations import is_nonlinear
from fkgen.problem import Spec

Array = NDArray[np.float64]

#: Ports by name.
Ports: TypeAlias = Mapping[str, Array]


@dataclass(frozen=True, eq=False, kw_only=True)
class Record:
    """A random record on which a recursion meets its closed forms."""

    y: Array  # (T, p): NaN where a row is missing
    u: Array  # (T, q)
    parameters: Mapping[str, Array]  # (T,)
    #: (n, n): Prior covariance of this record: that of the spec, or a milder one, because the
    #: equations are on trial here and not the digits that an extreme prior costs
    P0: Array

    @property
    def first(self) -> dict[str, float]:
        """The parameters of sample 0."""
        return {name: float(values[0]) for name, values in self.parameters.items()}

    def sample(self, k: int) -> tuple[Array, Array, dict[str, float]]:
        """One sample: y, u and parameters."""
        now = {name: float(values[k]) for name, values in self.parameters.items()}
        return self.y[k], self.u[k], now

    def first_samples(self, count: int) -> Record:
        """The record of fewer samples."""
        parameters = {name: values[:count] for name, values in self.parameters.items()}
        return replace(self, y=self.y[:count], u=self.u[:count], parameters=parameters)


@dataclass(frozen=True, slots=True, kw_only=True)
class ClosedForm:
    """A statement about a recursion that an independent formula decides."""

    claim: str  # claim, source: What holds, and where it comes from
    source: str
    tolerance: Callable[[Spec, Record], float]  # Largest relative error at which it holds
    #: Ports with shape (T, ...), or of fewer samples if the statement is about the first ones
    #: only, without any code of the recursion; None if it is not about this spec. NaN = missing
    expected: Callable[[Spec, Record], Ports | None]
    start: Callable[[Spec, Record], Ports] | None = None  # What replaces the prior, unpacked
    steady: bool = False  # The record has constant inputs, default parameters and no missing rows


def of_matrices(
    expected: Callable[[Spec, Record], Ports | None],
) -> Callable[[Spec, Record], Ports | None]:
    """The same statement, which says nothing about plants by equations."""
    return lambda spec, record: None if is_nonlinear(spec) else expected(spec, record)


def ports(result: object, *without: str) -> dict[str, Array]:
    """What an oracle found, but for some ports."""
    return {name: value for name, value in vars(result).items() if name not in without}
