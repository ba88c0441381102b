"""Matrices that stay arrays of a phase, and products of them whose text does not grow.

Rows lie one after the other, each of a length that vectors of four divide; what is beyond its
columns is zero and stays so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.index import At, Whole, packed, variable
from fkgen.symbolic.linalg import column, is_zero, total

#: Numbers that a vector holds.
LANES = 4

#: What names of arrays begin with, beside those of ports and of other variables.
PREFIX = "dense_"

_I, _J, _K = map(variable, "ijk")


@dataclass(frozen=True, slots=True)
class Dense:
    """A matrix whose entry (i, j) is at ``begin + step i + stride j`` of a variable."""

    name: str
    rows: int
    columns: int
    step: int
    stride: int = 1
    begin: int = 0

    @property
    def T(self) -> Dense:
        """Its transpose, in the same place."""
        return Dense(self.name, self.columns, self.rows, self.stride, self.step, self.begin)

    def at(self, i: Whole, j: Whole) -> At:
        """The place of an entry."""
        return At(self.name, self.step * i + self.stride * j + self.begin)

    def row(self, i: int, columns: int | None = None) -> Dense:
        """One of its rows, as far as these columns."""
        width = self.columns if columns is None else columns
        return Dense(self.name, 1, width, self.step, self.stride, self.begin + self.step * i)

    def top(self, rows: int) -> Dense:
        """Its first rows."""
        return Dense(self.name, rows, self.columns, self.step, self.stride, self.begin)


def whole_vectors(columns: int) -> int:
    """Numbers in the vectors that so many need."""
    return -(-columns // LANES) * LANES


def room(builder: PhaseBuilder, name: str, rows: int, columns: int) -> Dense:
    """An array for a matrix; what is done with it later may be another matrix of this size."""
    step, name = whole_vectors(columns), PREFIX + name
    if builder.has(name) and builder.symbol(name).numel() != rows * step:
        name = f"{name}_{rows}x{columns}"
    if not builder.has(name):
        builder.local(name, rows * step, None if step == columns else 0.0)
    return Dense(name, rows, columns, step)


def as_row(builder: PhaseBuilder, name: str, vector: ca.SX) -> Dense:
    """A vector as a matrix of one row, where it is if it is a variable of whole vectors."""
    size = vector.numel()
    owner = builder.owner_of(vector) if size % LANES == 0 else None
    if owner is not None:
        return Dense(owner, 1, size, size)
    found = room(builder, name, 1, size)
    builder.assign({found.at(0, k): vector[k] for k in range(size)})
    return found


def filled(builder: PhaseBuilder, name: str, matrix: ca.SX) -> Dense:
    """A matrix of numbers and expressions in an array; one of numbers is a table."""
    rows, columns = matrix.shape
    step = whole_vectors(columns)
    values = [matrix[i, j] if j < columns else ca.SX(0) for i in range(rows) for j in range(step)]
    return Dense(fill(builder, PREFIX + name, values), rows, columns, step)


def fill(
    builder: PhaseBuilder, name: str, values: Sequence[ca.SX], *, changes: bool = False
) -> str:
    """The array of these values; one of constants that never changes is a table."""
    size = len(values)
    known = [value.is_constant() for value in values]
    numbers = [float(v) if k else 0.0 for v, k in zip(values, known, strict=True)]
    if all(known) and not changes:
        return builder.table(name, numbers)
    if builder.has(name):
        return name
    builder.local(name, size)
    if any(known):
        table = builder.table(f"{name}_0", numbers)
        with builder.loop("i", 0, size) as i:
            builder.assign({At(name, i): builder.at(table, i)})
    rest = {At(name, k): value for k, value in enumerate(values) if not known[k]}
    if len(rest) == size:
        builder.assign({name: column(list(values))})
    elif rest:
        builder.assign(rest)
    return name


def unpacked(builder: PhaseBuilder, name: str, covariance: ca.SX, size: int) -> Dense:
    """A packed symmetric matrix with all of its entries."""
    source = builder.array(f"{PREFIX}{name}_of_{size}", covariance)
    found = room(builder, name, size, size)
    builder.triangle(found.at(_I, _J), At(source, packed(_I, _J)), size, mirrored=True)
    return found


def as_packed(builder: PhaseBuilder, name: str, matrix: Dense) -> ca.SX:
    """The lower triangle of a symmetric matrix, packed, in a variable of its own."""
    size = matrix.rows
    found = builder.local(name, size * (size + 1) // 2)
    builder.triangle(At(name, packed(_I, _J)), matrix.at(_I, _J), size, mirrored=False)
    return found


def multiply(
    builder: PhaseBuilder,
    target: Dense,
    left: Dense,
    right: Dense,
    start: Dense | None = None,
    *,
    less: bool = False,
    lower: bool = False,
) -> Dense:
    """Append target := start + left right, or with ``less`` start - left right.

    With ``lower`` entries above the diagonal are left alone. The target may be the start.
    """
    factors = left.at(_I, _K), right.at(_K, _J)
    sizes = left.rows, right.columns, left.columns
    begin = None if start is None else start.at(_I, _J)
    builder.product(target.at(_I, _J), factors, sizes, begin, less=less, lower=lower)
    return target


def combine(
    builder: PhaseBuilder,
    target: Dense,
    left: ca.SX,
    right: Dense,
    start: Dense | None = None,
    *,
    lower: bool = False,
) -> Dense:
    """The same for a left factor with many zeros: each row is a sum of a few rows of the other.

    ``lower`` goes on to the end of a vector, in the room that rows have.
    """
    for i in range(left.shape[0]):
        places = [k for k in range(left.shape[1]) if not is_zero(left[i, k])]
        end = whole_vectors(i + 1) if lower else right.columns
        with builder.loop("j", 0, end) as j:
            terms = [left[i, k] * builder.read(right.at(k, j)) for k in places]
            first = [] if start is None else [builder.read(start.at(i, j))]
            builder.assign({target.at(i, j): total([*first, *terms] or [ca.SX(0)])})
    return target


def transposed(builder: PhaseBuilder, target: Dense, matrix: Dense) -> Dense:
    """The transpose in a place of its own."""
    with builder.loop("i", 0, matrix.rows) as i, builder.loop("j", 0, matrix.columns) as j:
        builder.assign({target.at(j, i): builder.read(matrix.at(i, j))})
    return target
