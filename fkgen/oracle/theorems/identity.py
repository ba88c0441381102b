"""Identities that SymPy decides: residuals that are exactly zero for every value of their symbols.

A rational function is zero if and only if its expanded numerator is. SymPy is slow to import and
has no static types: it is loaded when a residual is first written, and `Any` stands for its values.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, TypeAlias

#: Writes down matrices, or lists of entries, that must be zero.
Residual: TypeAlias = Callable[[], tuple[Any, ...]]


class _Late:
    def __getattr__(self, name: str) -> Any:
        return getattr(import_module("sympy"), name)


#: SymPy, loaded when a name of it is first used.
sympy: Any = _Late()


@dataclass(frozen=True, eq=False, kw_only=True)
class Identity:
    """One claim and what must vanish if it is true."""

    claim: str
    source: str
    residual: Residual

    def holds(self) -> bool:
        """Whether every entry of the residual is identically zero."""
        entries = (entry for matrix in self.residual() for entry in sympy.Matrix(matrix))
        return all(sympy.expand(sympy.numer(sympy.together(entry))) == 0 for entry in entries)


@dataclass(frozen=True)
class Theorems:
    """The identities about one paper, in the order of its derivation."""

    paper: str
    identities: list[Identity] = field(default_factory=list)

    def claim(self, claim: str, equations: str) -> Callable[[Residual], Residual]:
        """Decorator that states what a residual proves."""

        def add(residual: Residual) -> Residual:
            source = f"{self.paper}, {equations}"
            self.identities.append(Identity(claim=claim, source=source, residual=residual))
            return residual

        return add


def general(name: str, rows: int, columns: int) -> Any:
    """A matrix of real symbols."""
    return sympy.Matrix(rows, columns, lambda i, j: sympy.Symbol(f"{name}{i}{j}", real=True))


def symmetric(name: str, size: int) -> Any:
    """A symmetric matrix of real symbols."""
    lower = general(name, size, size)
    return sympy.Matrix(size, size, lambda i, j: lower[max(i, j), min(i, j)])


def scalar(name: str) -> Any:
    """One real symbol as a matrix."""
    return sympy.Matrix([[sympy.Symbol(name, real=True)]])
