"""What a family is: a value with a builder, closed forms and theorems."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from fkgen.oracle import Identity
from fkgen.oracle.claims.claim import ClosedForm
from fkgen.problem import Spec
from fkgen.problem.finding import Finding
from fkgen.symbolic.recursion import Recursion


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
