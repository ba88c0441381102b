"""Where loops read and write: sums of multiples of their variables, and places in packed matrices.

An index that no variable is left in is a plain number. The triangle of v is v (v + 1) / 2, where
row v of a packed symmetric matrix begins.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import InternalError


@dataclass(frozen=True, slots=True)
class Index:
    """The sum of ``factor * v + triangles * v (v + 1) / 2`` over variables v, and a constant."""

    terms: tuple[tuple[str, int, int], ...]  # v, factor, triangles; by name, none of them 0 and 0
    constant: int = 0

    def __add__(self, other: Whole) -> Whole:
        """The sum; a number if the variables cancel."""
        if isinstance(other, int):
            return Index(self.terms, self.constant + other)
        both: dict[str, tuple[int, int]] = {}
        for name, factor, triangles in (*self.terms, *other.terms):
            a, b = both.get(name, (0, 0))
            both[name] = a + factor, b + triangles
        terms = tuple((name, *both[name]) for name in sorted(both) if any(both[name]))
        constant = self.constant + other.constant
        return Index(terms, constant) if terms else constant

    __radd__ = __add__

    def __mul__(self, factor: int) -> Whole:
        """A multiple."""
        terms = tuple((name, factor * a, factor * b) for name, a, b in self.terms)
        return Index(terms, factor * self.constant) if factor else 0

    __rmul__ = __mul__

    def __sub__(self, other: Whole) -> Whole:
        """The difference; a number if the variables cancel."""
        return self + -1 * other

    def __rsub__(self, other: Whole) -> Whole:
        """The difference of a number and this."""
        return -1 * self + other

    def at(self, variables: Mapping[str, Any]) -> Any:
        """Its value, or values if a variable stands for several numbers."""
        result: Any = self.constant
        for name, factor, triangles in self.terms:
            v = variables[name]
            result = result + factor * v
            if triangles:
                result = result + triangles * (v * (v + 1) // 2)
        return result

    def rises_with(self, variable: str) -> bool:
        """Whether it has another value, and a larger one, for each larger value of a variable."""
        return any(name == variable and min(a, b) >= 0 for name, a, b in self.terms)

    def __str__(self) -> str:
        """As C writes it."""
        parts = []
        for name, factor, triangles in self.terms:
            for count, text in ((triangles, f"{name} * ({name} + 1) / 2"), (factor, name)):
                if count:
                    sign, size = "-" if count < 0 else "+", abs(count)
                    parts.append((sign, text if size == 1 else f"{size} * {_grouped(text)}"))
        if self.constant:
            parts.append(("-" if self.constant < 0 else "+", str(abs(self.constant))))
        parts.sort(key=lambda part: part[0] == "-")
        (sign, first), *rest = parts
        return " ".join([*(["-"] * (sign == "-")), first, *(f"{s} {text}" for s, text in rest)])


Whole = int | Index


def _grouped(text: str) -> str:
    return f"({text})" if " " in text else text


def variable(name: str) -> Index:
    """The variable of a loop as an index."""
    return Index(((name, 1, 0),))


def triangle_of(index: Whole) -> Whole:
    """Where a row of a packed symmetric matrix begins."""
    if isinstance(index, int):
        return index * (index + 1) // 2
    match index:
        case Index(((name, 1, 0),), c):
            return Index(((name, c, 1),), c * (c + 1) // 2)
    raise InternalError(f"the triangle of {index} is no index")


def packed(i: Whole, j: Whole) -> Whole:
    """Where entry (i, j), j <= i, of a symmetric matrix is, its lower triangle stored by rows."""
    return triangle_of(i) + j


def entries(rows: int, columns: int, *, lower: bool) -> dict[str, NDArray[np.intp]]:
    """Rows i and columns j of the entries of a matrix, or of those on and below its diagonal."""
    i, j = np.tril_indices(rows, 0, columns) if lower else np.indices((rows, columns))
    return {"i": i.ravel(), "j": j.ravel()}


def value(index: Whole, variables: Mapping[str, Any]) -> Any:
    """An index, or a number, with its variables known."""
    return index if isinstance(index, int) else index.at(variables)


@dataclass(frozen=True, slots=True)
class At:
    """One element of a variable."""

    name: str
    index: Whole


#: A variable as a whole, or an element of it.
Target = str | At


def name_of(target: Target) -> str:
    """The variable that a target is, or is an element of."""
    return target if isinstance(target, str) else target.name


def names_in(*indices: object) -> Iterator[str]:
    """The variables of loops that indices depend on."""
    for index in indices:
        if isinstance(index, Index):
            yield from (name for name, _, _ in index.terms)
