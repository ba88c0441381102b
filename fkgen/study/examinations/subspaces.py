"""What y does not show and what noise does not reach: invariant subspaces, whatever the units are.

Decided on scaled matrices: states are scaled so that what enters and what leaves each of them is of
one size, measurements so that each row of C has length one. Changing the unit of a state or a
measurement changes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Singular values below this, relative to the size of the scaled matrices, count as zero: the
#: matrices are known to about ten digits at best.
RANK_TOLERANCE = 1e-10

#: An eigenvalue this near to the unit circle counts as on it; a defective one is known no better.
ON_THE_CIRCLE = 1e-7

_SWEEPS = 12
_INVOLVED = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Hidden:
    """A subspace that A maps into itself and that cannot be seen (or reached).

    Attributes
    ----------
    size : int
        Its dimension.
    states : tuple of int
        Indices of the states that have a share in it.
    eigenvalues : (size,) ndarray of complex
        Of A within it.
    """

    size: int
    states: tuple[int, ...]
    eigenvalues: NDArray[np.complex128]


def unobservable(A: Array, C: Array) -> Hidden:
    """The largest A-invariant subspace within the null space of C.

    Parameters
    ----------
    A, C : (n, n), (p, n) ndarray
    """
    n = len(A)
    scale = _scaled(A, C)
    M = A * scale[np.newaxis, :] / scale[:, np.newaxis]
    rows = C * scale[np.newaxis, :]
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    rows = np.divide(rows, length, out=np.zeros_like(rows), where=length > 0.0)
    V = _null_space(rows, np.eye(n), 1.0)
    while V.shape[1]:
        outside = M @ V - V @ (V.T @ (M @ V))
        smaller = _null_space(outside, V, max(1.0, float(np.linalg.norm(M, 2))))
        if smaller.shape[1] == V.shape[1]:
            break
        V = smaller
    involved = np.flatnonzero(np.linalg.norm(V, axis=1) > _INVOLVED)
    within = np.linalg.eigvals(V.T @ M @ V).astype(complex) if V.shape[1] else np.zeros(0, complex)
    return Hidden(V.shape[1], tuple(int(i) for i in involved), within)


def unreachable(A: Array, Q: Array) -> Hidden:
    """What noise of covariance Q never reaches: the dual of `unobservable`.

    Parameters
    ----------
    A, Q : (n, n) ndarray
    """
    size, correlation = correlations(Q)
    values, vectors = np.linalg.eigh(correlation)
    kept = values > RANK_TOLERANCE
    root = size[:, np.newaxis] * vectors[:, kept] * np.sqrt(values[kept])
    return unobservable(A.T, root.T)


def numerical_rank(covariance: Array) -> int:
    """Rank of a covariance, decided on correlations: units do not matter."""
    _, correlation = correlations(covariance)
    return int(np.count_nonzero(np.linalg.eigvalsh(correlation) > RANK_TOLERANCE))


def correlations(covariance: Array) -> tuple[Array, Array]:
    """Standard deviations and correlations; zero rows where there is no variance."""
    size = np.sqrt(np.diag(covariance).clip(0.0))
    outer = np.outer(size, size)
    return size, np.divide(covariance, outer, out=np.zeros_like(covariance), where=outer > 0.0)


def _scaled(A: Array, C: Array) -> Array:
    """Scales d for which diag(1/d) A diag(d) and C diag(d) are balanced (Osborne's sweeps)."""
    n = len(A)
    d = np.ones(n)
    for _ in range(_SWEEPS):
        rows = C * d[np.newaxis, :]
        length = np.linalg.norm(rows, axis=1, keepdims=True)
        rows = np.divide(rows, length, out=np.zeros_like(rows), where=length > 0.0)
        for i in range(n):
            others = np.arange(n) != i
            leaves = float(
                np.hypot(
                    np.linalg.norm(A[others, i] * d[i] / d[others]), np.linalg.norm(rows[:, i])
                )
            )
            enters = float(np.linalg.norm(A[i, others] * d[others] / d[i]))
            if leaves > 0.0 and enters > 0.0:
                factor = np.sqrt(enters / leaves)
            elif leaves > 0.0:
                factor = 1.0 / leaves
            else:
                factor = enters or 1.0
            d[i] *= factor
            rows[:, i] *= factor
    return d


def _null_space(matrix: Array, basis: Array, size: float) -> Array:
    """The part of a basis on which a matrix vanishes."""
    if not matrix.shape[0]:
        return basis
    _, singular, right = np.linalg.svd(matrix)
    rank = int(np.count_nonzero(singular > RANK_TOLERANCE * size))
    return np.asarray(basis @ right[rank:].T)
