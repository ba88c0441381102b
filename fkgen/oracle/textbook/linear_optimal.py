"""The linear filter as the paper prints it: second moments of the estimate, eq. (19)-(23).

The difference C - V loses all digits where the state grows without bound; the derivation says so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fkgen.errors import DataError
from fkgen.oracle.exact.batch import Estimates
from fkgen.oracle.exact.gaussian import Array
from fkgen.oracle.exact.moments import FaultMoments
from fkgen.oracle.exact.uncertain import require_sensor_faults_only
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.plants.sensor import SAME_PROBABILITY, SensorLaw, mode_plant
from fkgen.oracle.textbook.mkf import scaled_pseudo_inverse


@dataclass(frozen=True, eq=False, kw_only=True)
class LinearOptimalResult(Estimates):
    """xhat_k, C_k - V_k (its covariance if Lemma 2 holds), y[k] - Pi (C x(k|k-1) + D u)."""

    #: (T, n, n), (T, n, p): F1 and F2: xhat_k = F1 xhat_(k-1) + F2 y_k + offset; F1(0) multiplies
    #: x0
    state_gain: Array
    measurement_gain: Array
    offset: Array  # (T, n): The part of the known inputs
    state_second_moment: Array  # (T, n, n): C_k = E[x_k x_k'], and V_k = E[xhat_k xhat_k']
    estimate_second_moment: Array


def linear_optimal(
    system: LinearSystem, moments: FaultMoments, y: Array, u: Array | None
) -> LinearOptimalResult:
    """Run eq. (23) from an update of the prior: Sigalov & Oshman, (19)-(23); y (T, p), u (T, q).

    Known inputs and a mean of x[0] enter through a constant beside x: (x, 1). Where a row never
    fails, C - V is the error covariance only if p11 = E[gamma].
    """
    require_sensor_faults_only(system, moments)
    u = system.inputs(u)
    _require_zero_mean(system, moments, u)
    n, faulty = system.nx, moments.faulty(system.ny)
    either = np.maximum.outer(faulty, faulty)
    gain, noise = moments.gains(system.ny), moments.noise(system.R)
    Pi = moments.persistence[:, None] * faulty + 1.0 - faulty
    pair = moments.gamma[:, None, None] * either + 1.0 - either  # E[G_i G_j]
    estimate = np.append(system.x0, 1.0)
    X, V = np.outer(estimate, estimate), np.outer(estimate, estimate)
    X[:n, :n] += system.P0
    before, rows = np.eye(n + 1), []  # no time update in front of sample 0
    for k in range(system.length):
        h = np.column_stack([system.C[k], system.D[k] @ u[k] + system.d[k]])
        row, F1, V = _update((h, gain[k], Pi[k], pair[k], noise[k]), estimate, (X, V), y[k])
        estimate = F1 @ estimate
        estimate[:n] += row["measurement_gain"] @ np.where(np.isfinite(y[k]), y[k], 0.0)
        gains, onward = F1 @ before, np.eye(n + 1)
        row |= {"state_gain": gains[:n, :n], "offset": gains[:n, n]}
        row |= {"state_second_moment": X[:n, :n], "estimate_second_moment": V[:n, :n]}
        row |= {"filtered_state": estimate[:n], "filtered_covariance": (X - V)[:n, :n]}
        onward[:n, :n], onward[:n, n] = system.A[k], system.B[k] @ u[k] + system.c[k]
        estimate, X, V = onward @ estimate, onward @ X @ onward.T, onward @ V @ onward.T
        X[:n, :n] += system.Q[k]
        row |= {"predicted_state": estimate[:n], "predicted_covariance": (X - V)[:n, :n]}
        before = onward
        rows.append(row)
    return LinearOptimalResult.of(rows)


def _update(
    signal: tuple[Array, ...], predicted: Array, second: tuple[Array, Array], y: Array
) -> tuple[dict[str, Array], Array, Array]:
    """Eq. (22)-(23e) for y = G h (x, 1) + v, from (C_(k+1), A V_k A'): the ports, F1, V_(k+1).

    `signal`: h, the diagonals of E[G] and Pi, E[G_i G_j], E[T R T].
    """
    h, gain, persistence, pair, noise = signal
    (X, V), n, finite = second, len(predicted) - 1, np.isfinite(y)
    y_y = pair * (h @ X @ h.T) + noise
    x_y, xhat_y = X @ h.T * gain, V @ h.T * persistence
    expected = persistence[:, None] * h
    innovation = y_y - expected @ V @ expected.T
    F2 = np.zeros((n + 1, len(y)))  # a missing row has no gain; the constant needs no correction
    inverse = scaled_pseudo_inverse(innovation[np.ix_(finite, finite)])
    F2[:n, finite] = (x_y - xhat_y)[:n, finite] @ inverse
    F1 = np.eye(n + 1) - F2 @ expected
    cross = F1 @ xhat_y @ F2.T
    row = {
        "measurement_gain": F2[:n],
        "innovation": y - expected @ predicted,
        "innovation_covariance": innovation,
    }
    return row, F1, F1 @ V @ F1.T + F2 @ y_y @ F2.T + cross + cross.T


def _require_zero_mean(system: LinearSystem, moments: FaultMoments, u: Array) -> None:
    """Refuse a constant part in y that Lemma 2 does not cover."""
    constant = np.abs(moments.persistence - moments.gamma).max(initial=0.0) <= SAME_PROBABILITY
    parts = (system.B, system.c), (system.D, system.d)
    driven = any(((M @ u[:, :, None])[..., 0] + known).any() for M, known in parts)
    if not constant and (driven or system.x0.any()):
        raise DataError(
            "x0 and u", given="values that are not zero", expected="zero unless p11 = E[gamma]"
        )


def true_covariance(
    system: LinearSystem,
    law: SensorLaw,
    gains: tuple[Array, Array],
    u: Array | None = None,
    offset: Array | None = None,
) -> Array:
    """Exact mean square error (T, n, n) of a linear filter with given gains, by moments per mode.

    Shapes: gains (T, n, n) and (T, n, p); u (T, q); offset (T, n).
    """
    require_sensor_faults_only(system, FaultMoments.from_law(law, system.length))
    T, n, (F1, F2), u = system.length, system.nx, gains, system.inputs(u)
    shift = np.zeros((T, n)) if offset is None else offset
    start = np.concatenate([system.x0, system.x0, [1.0]])  # the estimate before sample 0 is x0
    second = np.outer(start, start)
    second[:n, :n] += system.P0
    by_mode = law.initial[:, None, None] * second
    error = np.hstack([np.eye(n), -np.eye(n), np.zeros((n, 1))])
    update, onward, covariance = np.eye(2 * n + 1), np.eye(2 * n + 1), np.empty((T, n, n))
    for k in range(T):
        for mode in range(4):
            C, D, R, d = mode_plant(system, law, k, mode)
            known = F2[k] @ (D @ u[k] + d) + shift[k]
            update[n:-1] = np.column_stack([F2[k] @ C, F1[k], known])
            by_mode[mode] = update @ by_mode[mode] @ update.T
            by_mode[mode, n:-1, n:-1] += by_mode[mode, -1, -1] * (F2[k] @ R @ F2[k].T)
        covariance[k] = error @ by_mode.sum(axis=0) @ error.T
        onward[:n, :n], onward[:n, -1] = system.A[k], system.B[k] @ u[k] + system.c[k]
        by_mode = onward @ np.einsum("ij,iab->jab", law.kernel, by_mode) @ onward.T
        by_mode[:, :n, :n] += by_mode[:, -1:, -1:] * system.Q[k]
    return covariance
