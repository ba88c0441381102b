"""Matrices whose entries are expressions of the parameters."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.problem.text.expression import (
    ZERO,
    Computed,
    Expression,
    Name,
    Number,
    Operation,
    evaluate,
    names,
    product,
    to_text,
    total,
)

NO_PARAMETERS: Mapping[str, float] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class Matrix:
    """A frozen matrix of expressions."""

    #: The entries, row by row; all rows have the same length. A matrix without columns is rows
    #: that are empty
    rows: tuple[tuple[Expression, ...], ...]

    @classmethod
    def of(cls, values: ArrayLike) -> Matrix:
        """Return the constant matrix with these values."""
        array = np.atleast_2d(np.asarray(values, dtype=np.float64))
        return cls(tuple(tuple(Number(float(value)) for value in row) for row in array))

    @classmethod
    def zeros(cls, row_count: int, column_count: int) -> Matrix:
        """Return a matrix of zeros."""
        return cls(((ZERO,) * column_count,) * row_count)

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of rows and columns."""
        return len(self.rows), len(self.rows[0]) if self.rows else 0

    @property
    def names(self) -> frozenset[str]:
        """The parameters it depends on."""
        return frozenset().union(*(names(entry) for row in self.rows for entry in row))

    @property
    def is_constant(self) -> bool:
        """Whether it depends on no parameter."""
        return all(isinstance(entry, Number) for row in self.rows for entry in row)

    @property
    def is_zero(self) -> bool:
        """Whether every entry is the constant zero."""
        return all(entry == ZERO for row in self.rows for entry in row)

    def mapped(self, change: Callable[[int, int, Expression], Expression]) -> Matrix:
        """Return the matrix of ``change(i, j, entry)``."""
        return Matrix(
            tuple(
                tuple(change(i, j, entry) for j, entry in enumerate(row))
                for i, row in enumerate(self.rows)
            )
        )

    def values(self, parameters: Mapping[str, float] = NO_PARAMETERS) -> NDArray[np.float64]:
        """Return the values for given parameters."""
        rows = [[evaluate(entry, parameters) for entry in row] for row in self.rows]
        return np.array(rows, float).reshape(self.shape)

    def plain(self) -> Any:
        """Return the entries as a spec file writes them: numbers, and texts for expressions."""
        return plain(self.rows)

    def plain_column(self) -> Any:
        """Return the entries of a column as a list."""
        return [plain(row[0]) for row in self.rows]


def plain(value: object) -> object:
    """Return a value as a spec file writes it: numbers, texts, lists and tables."""
    match value:
        case Number(number):
            return number
        case Name() | Operation():
            return to_text(value)
        case tuple():
            return [plain(entry) for entry in value]
        case _ if hasattr(value, "plain"):
            return value.plain()
        case _:
            return plain_fields(value) if is_dataclass(value) else value


def plain_fields(value: Any) -> dict[str, object]:
    """Return the fields of a dataclass as the table of a spec file; None is left out."""
    table = {each.name: plain(getattr(value, each.name)) for each in fields(value)}
    return {key: entry for key, entry in table.items() if entry is not None}


def expressions(value: object) -> Iterator[Expression]:
    """Yield every expression in matrices, tuples and dataclasses, however deep.

    What is computed as a whole stands for the matrices that it is computed from.
    """
    match value:
        case Number() | Name() | Operation():
            yield value
        case Computed():
            return
        case tuple():
            for entry in value:
                yield from expressions(entry)
        case _ if is_dataclass(value):
            for each in fields(value):
                yield from expressions(getattr(value, each.name))


def mirrored(matrix: Matrix) -> Matrix:
    """Return the symmetric matrix with the lower triangle of this one."""
    return matrix.mapped(lambda i, j, entry: matrix.rows[j][i] if i < j else entry)


def congruence(left: Matrix, middle: Matrix) -> Matrix:
    """Return ``left @ middle @ left.T``, exactly symmetric."""
    count = range(len(middle.rows))

    def entry(i: int, j: int) -> Expression:
        terms = (
            product((left.rows[i][k], middle.rows[k][m], left.rows[j][m]))
            for k in count
            for m in count
        )
        return total([term for term in terms if term != ZERO])

    size = range(len(left.rows))
    lower = (tuple(entry(i, j) if j <= i else ZERO for j in size) for i in size)
    return mirrored(Matrix(tuple(lower)))
