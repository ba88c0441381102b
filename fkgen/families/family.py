"""What a family is: a value with a builder, closed forms and theorems."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fkgen.closed_form import Identity
from fkgen.families.finding import Finding
from fkgen.spec import Spec
from fkgen.symbolic.recursion import Recursion

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class Record:
    """A random record on which a recursion meets its closed forms.

    Attributes
    ----------
    y : (T, p) ndarray
        NaN where a row is missing.
    u : (T, q) ndarray
    parameters : mapping of str to (T,) ndarray
    P0 : (n, n) ndarray
        Prior covariance of this record: that of the spec, or a milder one, because the equations
        are on trial here and not the digits that an extreme prior costs.
    """

    y: Array
    u: Array
    parameters: Mapping[str, Array]
    P0: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class ClosedForm:
    """A statement about a recursion that an independent formula decides.

    Attributes
    ----------
    claim, source : str
        What holds, and where it comes from.
    tolerance : callable
        ``tolerance(spec, record)``: the largest relative error at which it is taken to hold.
    expected : callable
        ``expected(spec, record)`` gives ports by name with shape (T, ...), or of fewer samples if
        the statement is about the first ones only, without any code of the recursion; None if the
        statement is not about this spec. NaN = a missing row.
    start : callable
        ``start(spec, record)`` gives ports (unpacked) that replace the prior before the run.
    steady : bool
        The record has constant inputs, default parameters and no missing rows.
    """

    claim: str
    source: str
    tolerance: Callable[[Spec, Record], float]
    expected: Callable[[Spec, Record], Mapping[str, Array] | None]
    start: Callable[[Spec, Record], Mapping[str, Array]] | None = None
    steady: bool = False


def no_caveats(_: Spec) -> tuple[Finding, ...]:
    """For families that are what they say, whatever the spec."""
    return ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Family:
    """A filter family.

    Attributes
    ----------
    name : str
        As in ``filter.family``.
    title : str
        One line for ``fkgen families``.
    build : callable
        ``build(spec) -> Recursion``.
    closed_forms : tuple of ClosedForm
        All of them hold before any C is generated.
    theorems : tuple of Identity
        What SymPy proves once for all models.
    caveats : callable
        ``caveats(spec)``: where the filter of this spec is less than its name says.
    """

    name: str
    title: str
    build: Callable[[Spec], Recursion]
    closed_forms: tuple[ClosedForm, ...]
    theorems: tuple[Identity, ...] = ()
    caveats: Callable[[Spec], tuple[Finding, ...]] = no_caveats
