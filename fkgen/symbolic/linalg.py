"""Linear algebra on CasADi matrices that keeps zeros structural and symmetric matrices halved.

Symmetric matrices travel packed: the lower triangle by rows, (0,0), (1,0), (1,1), (2,0), ...
"""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable, Sequence
from functools import reduce

import casadi as ca

from fkgen.symbolic.interface import triangle

TURN = 2.0 * math.pi

#: Up to so many states coefficients of products are folded into one constant, see `congruence`.
FOLDED = 3


def column(values: list[ca.SX]) -> ca.SX:
    """Stack scalars into a dense column."""
    return ca.densify(ca.vertcat(*values)) if values else ca.SX(0, 1)


def pack(matrix: ca.SX) -> ca.SX:
    """Lower triangle of a symmetric (n, n) matrix as an n(n+1)/2 column."""
    return column([matrix[i, j] for i, j in triangle(matrix.shape[0])])


def between(parts: Sequence[int], order: Sequence[int] | None = None) -> tuple[int, ...]:
    """Where a packed covariance, or one with its rows in an order, has entries between parts."""
    n = len(parts)
    labels = [parts[i] for i in (range(n) if order is None else order) if i < n]
    return tuple(at for at, (i, j) in enumerate(triangle(n)) if labels[i] != labels[j])


def cleared(packed: ca.SX, places: Sequence[int], others: ca.SX | None = None) -> ca.SX:
    """The same with 0, or with entries of another, in these places."""
    if not places:
        return packed
    result = ca.SX(packed)
    for at in places:
        result[at] = 0 if others is None else others[at]
    return result


def split_packed(packed: ca.SX, n: int) -> list[ca.SX]:
    """Symmetric (n, n) matrices that are stacked, each packed."""
    return list(ca.vertsplit(packed, n * (n + 1) // 2))


def split_estimates(states: ca.SX, packed: ca.SX, n: int) -> list[tuple[ca.SX, ca.SX]]:
    """Means and packed covariances of estimates of n numbers that are stacked."""
    means = ca.vertsplit(states, n)
    return list(zip(means, ca.vertsplit(packed, packed.numel() // len(means)), strict=True))


def order(packed: ca.SX) -> int:
    """Number n of rows of a packed (n, n) matrix."""
    return (math.isqrt(8 * packed.numel() + 1) - 1) // 2


def diagonal(packed: ca.SX) -> list[ca.SX]:
    """The variances of a packed covariance."""
    return [packed[i * (i + 3) // 2] for i in range(order(packed))]


def unpack(packed: ca.SX, n: int) -> ca.SX:
    """The symmetric (n, n) matrix of a packed column."""
    matrix = ca.SX.zeros(n, n)
    for k, (i, j) in enumerate(triangle(n)):
        matrix[i, j] = matrix[j, i] = packed[k]
    return sparse(matrix)


def sparse(matrix: ca.SX) -> ca.SX:
    """Turn entries that are the constant zero into structural zeros."""
    return ca.sparsify(matrix) if matrix.nnz() else matrix


def is_zero(scalar: ca.SX) -> bool:
    """Whether a 1 x 1 matrix is zero by structure or by value."""
    return bool(scalar.nnz() == 0 or scalar.is_zero())


def reduced(angle: ca.SX) -> ca.SX:
    """The same angle in (-pi, pi]."""
    return angle + TURN * ca.floor(0.5 - angle * (1.0 / TURN))


def outer_lower(a: ca.SX, b: ca.SX) -> ca.SX:
    """Packed lower triangle of ``a b'``, for products that are symmetric in exact arithmetic."""
    return column([a[i] * b[j] for i, j in triangle(a.numel())])


def congruence(M: ca.SX, P: ca.SX) -> ca.SX:
    """Packed ``M P M'`` for symmetric P; only the lower triangle is computed.

    Up to `FOLDED` states there is a second way, the sum over the distinct entries of P with
    products of M as coefficients, which wins when M is constant. The one with fewer operations is
    returned.
    """
    T = M @ P
    rows = M.shape[0]
    by_products = column([ca.mtimes(T[i, :], M[j, :].T) for i, j in triangle(rows)])
    if P.shape[0] > FOLDED:
        return by_products
    by_entries = column([_quadratic(M[i, :], P, M[j, :]) for i, j in triangle(rows)])
    return min(by_products, by_entries, key=operations)


def row_congruence(M: ca.SX, P: ca.SX) -> ca.SX:
    """Packed ``M P M'``, the second product of each entry along the emptier of its two rows."""
    T = M @ P
    rows = [sparse(M[i, :].T) for i in range(M.shape[0])]
    entries = []
    for i, j in triangle(len(rows)):
        a, b = (i, j) if rows[j].nnz() <= rows[i].nnz() else (j, i)
        entries.append(ca.mtimes(T[a, :], rows[b]))
    return column(entries)


def least_congruence(M: ca.SX, P: ca.SX) -> ca.SX:
    """Packed ``M P M'`` in the way that takes the fewest operations."""
    return min(row_congruence(M, P), congruence(M, P), key=operations)


def _quadratic(a: ca.SX, P: ca.SX, b: ca.SX) -> ca.SX:
    return total(
        (a[i] * b[j] + a[j] * b[i] if i != j else a[i] * b[i]) * P[i, j]
        for i, j in triangle(P.shape[0])
    )


def operations(expression: ca.SX) -> int:
    """Number of scalar operations needed to evaluate an expression."""
    arguments = ca.symvar(expression)
    function = ca.Function("count", arguments, [expression])
    return int(function.n_instructions() - len(arguments) - expression.nnz())


def weighted_sum(weights: ca.SX, columns: Sequence[ca.SX]) -> ca.SX:
    """Sum of ``weights[i] * columns[i]``; a single weight is one by definition."""
    if len(columns) == 1:
        return columns[0]
    return total(weights[i] * each for i, each in enumerate(columns))


def spread(weights: ca.SX, means: Sequence[ca.SX], mean: ca.SX) -> ca.SX:
    """Packed sum of ``w_i (m_i - m)(m_i - m)'``: positive semidefinite term by term."""
    if len(means) == 1:
        return ca.SX.zeros(len(triangle(mean.numel())))
    deviations = [each - mean for each in means]
    return total(outer_lower(weights[i] * d, d) for i, d in enumerate(deviations))


def total(matrices: Iterable[ca.SX]) -> ca.SX:
    """Sum of matrices of one shape."""
    return reduce(operator.add, matrices)


def by_rows(matrix: ca.SX) -> ca.SX:
    """Entries of a matrix row by row: the one place where CasADi's column order is turned."""
    return ca.densify(ca.reshape(matrix.T, matrix.numel(), 1))


def from_rows(values: ca.SX, rows: int) -> ca.SX:
    """The matrix with this many rows whose entries are given row by row."""
    return ca.reshape(values, values.numel() // rows, rows).T
