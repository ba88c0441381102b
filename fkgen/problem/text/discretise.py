"""A plant dx/dt = A x + B u + c + w whose u is held over a sample, exactly at the samples.

    x(t + T) = exp(A T) x + int exp(A s) ds (B u + c) + w,   Cov(w) = int exp(A s) Q exp(A' s) ds

over 0..T. Numbers come from exponentials of block matrices (Van Loan 1978) over a part of T, which
is doubled. Where a power of A vanishes by its zeros, as for positions, speeds and accelerations,
the series ends, and the results are expressions. Other plants whose entries or T are parameters are
computed as a whole at run time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fkgen.problem.text.expression import (
    ZERO,
    Computed,
    Expression,
    Name,
    Number,
    evaluate,
    operation,
    product,
    total,
)
from fkgen.problem.text.matrix import Matrix, mirrored

Array = NDArray[np.float64]

#: Letters that belong to dx/dt.
OF_TIME = ("A", "B", "c", "Q")


@dataclass(frozen=True, slots=True)
class Continuous:
    """The matrices of dx/dt, Q as a spectral density, and the sample time."""

    A: Matrix
    B: Matrix
    c: Matrix
    Q: Matrix
    sample_time: float | str

    @property
    def names(self) -> frozenset[str]:
        """The parameters that the result depends on."""
        matrices = self.A, self.B, self.c, self.Q
        own = {self.sample_time} if isinstance(self.sample_time, str) else set()
        return frozenset(own).union(*(each.names for each in matrices))

    @property
    def T(self) -> Expression:
        """The sample time."""
        return as_time(self.sample_time)

    @property
    def discrete(self) -> dict[str, Matrix]:
        """The same letters from sample to sample."""
        if not self.names:
            values = self.at(())
            return {
                letter: Matrix.of(values[letter]) for letter in OF_TIME if values[letter].size
            } | {letter: getattr(self, letter) for letter in OF_TIME if not values[letter].size}
        powers = self._powers()
        return self._whole() if powers is None else self._series(powers)

    def norm(self, values: Mapping[str, float]) -> float:
        """Largest row sum of A T."""
        size = np.abs(self.A.values(values)).sum(axis=1).max()
        return float(size * abs(evaluate(self.T, values)))

    def at(self, values: tuple[tuple[str, float], ...]) -> Mapping[str, Array]:
        """The values for given parameters."""
        return _values(self, values)

    def _whole(self) -> dict[str, Matrix]:
        """Entries that are computed as a whole; what is zero by structure is a number."""
        stated = {letter: _pattern(getattr(self, letter)) for letter in OF_TIME}
        reach = _reached(stated["A"])
        patterns = {
            "A": reach,
            "B": reach @ stated["B"],
            "c": reach @ stated["c"],
            "Q": reach @ stated["Q"] @ reach.T,
        }
        rows = {
            letter: tuple(
                tuple(
                    Computed(self, letter, i, j) if there else ZERO for j, there in enumerate(row)
                )
                for i, row in enumerate(pattern > 0)
            )
            for letter, pattern in patterns.items()
        }
        return {letter: Matrix(each) for letter, each in rows.items()}

    def _powers(self) -> list[Matrix] | None:
        """I, A, A^2, ... up to the last that is not zero by its zeros."""
        powers = [Matrix.of(np.eye(len(self.A.rows)))]
        while not powers[-1].is_zero:
            if len(powers) > len(self.A.rows):
                return None
            powers.append(_times(powers[-1], self.A))
        return powers[:-1]

    def _series(self, powers: list[Matrix]) -> dict[str, Matrix]:
        """Sum A^k T^k / k!, and its integrals term by term."""

        def weight(k: int, over: float) -> Expression:
            return operation("/", operation("**", self.T, Number(float(k))), Number(over))

        n = len(powers)
        own = [weight(k, float(math.factorial(k))) if k else Number(1.0) for k in range(n)]
        held = [weight(k + 1, float(math.factorial(k + 1))) for k in range(n)]
        grown = _sum([(power, factor) for power, factor in zip(powers, held, strict=True)])
        terms = []
        for i, left in enumerate(powers):
            for j, right in enumerate(powers):
                over = float(math.factorial(i) * math.factorial(j) * (i + j + 1))
                inner = _times(_times(left, self.Q), _turned(right))
                terms.append((inner, weight(i + j + 1, over)))
        return {
            "A": _sum(list(zip(powers, own, strict=True))),
            "B": _times(grown, self.B),
            "c": _times(grown, self.c),
            "Q": mirrored(_sum(terms)),
        }


def as_time(stated: float | str) -> Expression:
    """The seconds from sample to sample, a number or a parameter."""
    return Name(stated) if isinstance(stated, str) else Number(stated)


@lru_cache(maxsize=256)
def _values(source: Continuous, values: tuple[tuple[str, float], ...]) -> Mapping[str, Array]:
    """By exponentials of block matrices over T / 2^s, where they have all digits, then doubled."""
    from scipy.linalg import expm  # noqa: PLC0415 - slow to import

    given = dict(values)
    A, B, c, Q = (getattr(source, letter).values(given) for letter in OF_TIME)
    T, n = evaluate(source.T, given), len(A)
    doublings = max(0, math.ceil(math.log2(max(2.0 * float(np.linalg.norm(A, 1)) * abs(T), 1.0))))
    h, I = T / 2.0**doublings, np.eye(n)
    held = expm(np.block([[A, I], [np.zeros((n, 2 * n))]]) * h)[:n, n:]
    noise = expm(np.block([[-A, Q], [np.zeros((n, n)), A.T]]) * h)
    moved = I + A @ held
    covariance = noise[n:, n:].T @ noise[:n, n:]
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(doublings):
            held, covariance = held + moved @ held, covariance + moved @ covariance @ moved.T
            moved = I + A @ held
    if not np.isfinite(covariance).all():
        raise ArithmeticError("what it makes of a sample is too large")
    covariance = 0.5 * (covariance + covariance.T)
    return {"A": moved, "B": held @ B, "c": held @ c, "Q": covariance}


def _pattern(matrix: Matrix) -> NDArray[np.int64]:
    there = [[int(entry != ZERO) for entry in row] for row in matrix.rows]
    return np.array(there, np.int64).reshape(matrix.shape)


def _reached(pattern: NDArray[np.int64]) -> NDArray[np.int64]:
    """Where powers of a matrix have entries, that of power 0 included."""
    reach = np.eye(len(pattern), dtype=np.int64)
    for _ in range(len(pattern)):
        reach = ((reach + reach @ pattern) > 0).astype(np.int64)
    return reach


def _times(left: Matrix, right: Matrix) -> Matrix:
    """The product; terms that are zero are left out."""
    columns = range(right.shape[1])

    def entry(row: tuple[Expression, ...], j: int) -> Expression:
        terms = [
            product((a, right.rows[k][j]))
            for k, a in enumerate(row)
            if ZERO not in (a, right.rows[k][j])
        ]
        return total(terms)

    return Matrix(tuple(tuple(entry(row, j) for j in columns) for row in left.rows))


def _turned(matrix: Matrix) -> Matrix:
    return Matrix(tuple(zip(*matrix.rows, strict=True)))


def _sum(terms: list[tuple[Matrix, Expression]]) -> Matrix:
    """Sum factor_i matrix_i."""
    first = terms[0][0]

    def entry(i: int, j: int, _: Expression) -> Expression:
        found = [(each.rows[i][j], factor) for each, factor in terms]
        return total([product(pair) for pair in found if pair[0] != ZERO])

    return first.mapped(entry)
