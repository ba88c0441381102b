"""Identities that SymPy decides: a rational function is zero if its expanded numerator is.

SymPy is slow to import and has no static types: it is loaded late, `Any` stands for its values.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any, TypeAlias

#: Matrices, or lists of entries, that must be zero.
Zeros: TypeAlias = tuple[Any, ...]


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
    residual: Callable[[], Zeros]

    def holds(self) -> bool:
        """Whether every entry of the residual is identically zero."""
        entries = (entry for matrix in self.residual() for entry in sympy.Matrix(matrix))
        return all(sympy.expand(sympy.numer(sympy.together(entry))) == 0 for entry in entries)


class Theorems(list[Identity]):
    """The identities about one paper, in the order of its derivation."""

    def __init__(self, paper: str, *setting: Callable[[], Any]) -> None:
        super().__init__()
        self.paper, self.setting = paper, setting

    def claim(
        self, claim: str, equations: str, *setting: Callable[[], Any], paper: str = ""
    ) -> Callable[[Callable[..., Zeros]], None]:
        """Decorator that states what a residual proves, in the symbols of its setting."""

        def add(residual: Callable[..., Zeros]) -> None:
            self.append(
                Identity(
                    claim=claim,
                    source=f"{paper or self.paper}, {equations}",
                    residual=lambda: residual(*(each() for each in setting or self.setting)),
                )
            )

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
