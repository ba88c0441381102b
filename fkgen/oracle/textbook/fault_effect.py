"""How a fault spreads in a Kalman filter, as products of matrices: Song & Hu 2019, eqs. (6)-(26).

Which the paper leaves open: products have their newest factor on the left, the gain stands outside
of them, a step is on at k0, ..., k0 + i INCLUSIVE. ``M[k]`` carries sample k to k + 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fkgen.oracle.exact.gaussian import Array
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.textbook.mkf import scaled_pseudo_inverse
from fkgen.oracle.textbook.riccati import constant_input_noise


@dataclass(frozen=True, eq=False, kw_only=True)
class Gains:
    """What a Kalman filter does at each of T samples."""

    #: (T, n, p): Gain of x(k|k), eq. (4) with Q and with C of the sample; columns of missing
    #: rows are zero
    K: Array
    M: Array  # (T - 1, n, n): (I - K[k+1] C[k+1]) A[k]
    filtered: Array  # (T, n, n): P(k|k)
    innovation: Array  # (T, p, p): S[k] of all rows


def gains(system: LinearSystem, u: Array | None = None, y: Array | None = None) -> Gains:
    """Run the Riccati recursion (3), (4) in matrices, in Joseph form; u (T, q), y (T, p)."""
    T, n, p = system.length, system.nx, system.ny
    inputs = np.zeros((T, system.nu)) if u is None else u
    P = system.P0
    K, filtered, S = np.zeros((T, n, p)), np.zeros((T, n, n)), np.zeros((T, p, p))
    for k in range(T):
        C = system.C[k]
        Q, R, _ = constant_input_noise(system, inputs[k], k)
        rows = np.arange(p) if y is None else np.flatnonzero(~np.isnan(y[k]))
        S[k] = C @ P @ C.T + R
        inverse = scaled_pseudo_inverse(S[k][np.ix_(rows, rows)])
        K[k][:, rows] = P @ C[rows].T @ inverse
        E = np.eye(n) - K[k] @ C
        filtered[k] = E @ P @ E.T + K[k] @ R @ K[k].T
        P = system.A[k] @ filtered[k] @ system.A[k].T + Q
    kept = np.eye(n) - K[1:] @ system.C[1:]
    return Gains(K=K, M=kept @ system.A[:-1], filtered=filtered, innovation=S)


def product(M: Array, lo: int, hi: int) -> Array:
    """M[hi] M[hi-1] ... M[lo]; the identity if hi < lo."""
    result = np.eye(M.shape[-1])
    for k in range(lo, hi + 1):
        result = M[k] @ result
    return result


def after_pulse(M: Array, entry: Array, k0: int, i: int, a: Array) -> Array:
    """Deviation (n,) at k0 + i of a pulse ``a`` (m,) at k0, eqs. (9), (20); entry (T, n, m)."""
    return np.asarray(product(M, k0, k0 + i - 1) @ entry[k0] @ a)


def within_step(M: Array, entry: Array, k0: int, i: int, a: Array) -> Array:
    """Deviation at k0 + i of a step ``a`` that is on at k0, ..., k0 + i, eqs. (12), (23); (n,)."""
    pulses = [after_pulse(M, entry, k, k0 + i - k, a) for k in range(k0, k0 + i + 1)]
    return np.asarray(np.sum(pulses, axis=0))


def after_step(M: Array, entry: Array, span: tuple[int, int], j: int, a: Array) -> Array:
    """Deviation j samples after the last faulty one, eqs. (15) and (26); (n,)."""
    k0, i = span
    return np.asarray(product(M, k0 + i, k0 + i + j - 1) @ within_step(M, entry, k0, i, a))
