"""Identities that SymPy decides: a rational function is zero if its expanded numerator is.

SymPy is slow to import and has no static types: it is loaded late, `Any` stands for its values.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any, ClassVar, TypeAlias

#: Pairs of matrices, or of lists of entries, that must be equal.
Equations: TypeAlias = tuple[tuple[Any, Any], ...]


class _Late:
    def __getattr__(self, name: str) -> Any:
        return getattr(import_module("sympy"), name)


#: SymPy, loaded when a name of it is first used.
sympy: Any = _Late()


@dataclass(frozen=True, eq=False, kw_only=True)
class Identity:
    """One claim and what is equal if it is true: SymPy judges it, and Coq (`proofs/`)."""

    claim: str
    source: str
    equations: Callable[[], Equations]
    #: SymPy decides it whenever asked, and Coq has checked what tools/proofs.py prints of it
    standing: ClassVar[str] = "symbolic and machine-checked"

    def entries(self) -> list[tuple[Any, Any]]:
        """Left and right side of every entry; zero is stated of nothing that is not written."""
        pairs = [(sympy.Matrix(left), sympy.Matrix(right)) for left, right in self.equations()]
        return [each for left, right in pairs for each in zip(left, right, strict=True)]

    def holds(self) -> bool:
        """Whether the sides of every entry are identically equal."""
        differences = (left - right for left, right in self.entries())
        return all(sympy.expand(sympy.numer(sympy.together(each))) == 0 for each in differences)


class Theorems(list[Identity]):
    """The identities about one paper, in the order of its derivation."""

    def __init__(self, paper: str, *setting: Callable[[], Any]) -> None:
        super().__init__()
        self.paper, self.setting = paper, setting

    def claim(
        self, claim: str, equations: str, *setting: Callable[[], Any], paper: str = ""
    ) -> Callable[[Callable[..., Equations]], None]:
        """Decorator that states what equations prove, in the symbols of its setting."""

        def add(sides: Callable[..., Equations]) -> None:
            self.append(
                Identity(
                    claim=claim,
                    source=f"{paper or self.paper}, {equations}",
                    equations=lambda: sides(*(each() for each in setting or self.setting)),
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
