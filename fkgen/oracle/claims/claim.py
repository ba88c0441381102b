"""A claim: what an oracle says of a spec and a record, and how far a recursion may be from it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fkgen.problem import Spec

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class Record:
    """A random record on which a recursion meets its closed forms."""

    y: Array  # (T, p): NaN where a row is missing
    u: Array  # (T, q)
    parameters: Mapping[str, Array]  # (T,)
    #: (n, n): Prior covariance of this record: that of the spec, or a milder one, because the
    #: equations are on trial here and not the digits that an extreme prior costs
    P0: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class ClosedForm:
    """A statement about a recursion that an independent formula decides."""

    claim: str  # claim, source: What holds, and where it comes from
    source: str
    #: tolerance(spec, record): the largest relative error at which it is taken to hold
    tolerance: Callable[[Spec, Record], float]
    #: expected(spec, record) gives ports by name with shape (T, ...), or of fewer samples if
    #: the statement is about the first ones only, without any code of the recursion; None if
    #: the statement is not about this spec. NaN = a missing row
    expected: Callable[[Spec, Record], Mapping[str, Array] | None]
    #: start(spec, record) gives ports (unpacked) that replace the prior before the run
    start: Callable[[Spec, Record], Mapping[str, Array]] | None = None
    steady: bool = False  # The record has constant inputs, default parameters and no missing rows
