"""What a family is: a value with a builder, closed forms and theorems. Adding one edits nothing else."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fkgen.spec import Spec
from fkgen.symbolic.recursion import Recursion

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class Record:
    """A short random record on which a recursion meets its closed forms.

    Attributes
    ----------
    y : (T, p) ndarray
        NaN where a row is missing.
    u : (T, q) ndarray
    parameters : mapping of str to (T,) ndarray
    """

    y: Array
    u: Array
    parameters: Mapping[str, Array]


@dataclass(frozen=True, slots=True, kw_only=True)
class ClosedForm:
    """A statement about a recursion that an independent formula decides.

    Attributes
    ----------
    claim, source : str
        What holds, and where it comes from.
    tolerance : float
        Largest relative error at which it is taken to hold.
    because : str
        Why this tolerance.
    expected : callable
        ``expected(spec, record)`` gives the ports, by name with shape (T, ...), without any code of the
        recursion. NaN = not decided.
    applies : callable
        Whether the statement is about this spec at all.
    settle : int
        Samples of a steady record before the comparison; 0 compares every sample of a short record.
    """

    claim: str
    source: str
    tolerance: float
    because: str
    expected: Callable[[Spec, Record], Mapping[str, Array]]
    applies: Callable[[Spec], bool] = lambda _spec: True
    settle: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Theorem:
    """An identity of the family's equations that SymPy proves once for all models.

    ``residual()`` is zero if the identity holds.
    """

    claim: str
    source: str
    residual: Callable[[], float]


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
    theorems : tuple of Theorem
    starter : str
        A commented spec file to begin with.
    """

    name: str
    title: str
    build: Callable[[Spec], Recursion]
    closed_forms: tuple[ClosedForm, ...]
    theorems: tuple[Theorem, ...] = ()
