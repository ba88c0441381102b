"""The linear filter as the paper prints it: second moments of the estimate, eq. (19)-(23).

The difference C - V of two second moments loses all digits where the state grows without bound. It
is kept because it is what the derivation says; the recursion that it judges carries the covariance.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fkgen.errors import DataError
from fkgen.oracle.exact.gaussian import Array
from fkgen.oracle.exact.moments import FaultMoments
from fkgen.oracle.exact.uncertain import require_sensor_faults_only
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.plants.sensor import SAME_PROBABILITY, SensorLaw, mode_plant
from fkgen.oracle.textbook.mixture import stacked
from fkgen.oracle.textbook.mkf import scaled_pseudo_inverse


@dataclass(frozen=True, eq=False, kw_only=True)
class LinearOptimalResult:
    """Estimates of one record; names and times as the ports of a filter."""

    #: filtered_state, filtered_covariance: (T, n), (T, n, n): xhat_k and C_k - V_k, its error
    #: covariance if Lemma 2 holds
    filtered_state: Array
    filtered_covariance: Array
    #: predicted_state, predicted_covariance: (T, n), (T, n, n): The same one step ahead
    predicted_state: Array
    predicted_covariance: Array
    #: innovation, innovation_covariance: (T, p), (T, p, p): y[k] - Pi (C x(k|k-1) + D u), NaN
    #: where y is, and its covariance, all rows
    innovation: Array
    innovation_covariance: Array
    #: state_gain, measurement_gain: (T, n, n), (T, n, p): F1 and F2: xhat_k = F1 xhat_(k-1) +
    #: F2 y_k + offset; F1(0) multiplies x0
    state_gain: Array
    measurement_gain: Array
    offset: Array  # (T, n): The part of the known inputs
    #: state_second_moment, estimate_second_moment: (T, n, n): C_k = E[x_k x_k'] and V_k =
    #: E[xhat_k xhat_k']
    state_second_moment: Array
    estimate_second_moment: Array


def linear_optimal(
    system: LinearSystem, moments: FaultMoments, y: Array, u: Array | None
) -> LinearOptimalResult:
    """Run eq. (23) over a record, row 0 being an update of the prior.

    Known inputs and a mean of x[0] enter through a constant beside x: (x, 1). For a plant without
    them the matrices of (x, 1) fall apart into those of eq. (23) and the constant.

    A row that never fails asks for p11 = E[gamma], too, if C - V is to be the error covariance:
    gamma_i does not multiply what it says about gamma_k x_k, whose weight is E[gamma_k].

    Shapes: y (T, p); u (T, q). Sigalov, Oshman, eq. (19)-(23).
    """
    require_sensor_faults_only(system, moments)
    u = system.inputs(u)
    _require_zero_mean(system, moments, u)
    return LinearOptimalResult(**stacked(list(_samples(system, moments, y, u))))


def _samples(
    system: LinearSystem, moments: FaultMoments, y: Array, u: Array
) -> Iterator[dict[str, Array]]:
    """What `linear_optimal` reports, sample by sample."""
    n = system.nx
    estimate = np.append(system.x0, 1.0)
    X, V = np.outer(estimate, estimate), np.outer(estimate, estimate)
    X[:n, :n] += system.P0
    onward = np.eye(n + 1)  # no time update in front of sample 0
    for k, measurement in enumerate(_measurements(system, moments, u)):
        row, estimate, V = _update(measurement, estimate, (X, V), y[k])
        gains = row.pop("map") @ onward
        row |= {"state_gain": gains[:n, :n], "offset": gains[:n, n]}
        row |= {"state_second_moment": X[:n, :n], "estimate_second_moment": V[:n, :n]}
        row |= _estimate("filtered", estimate, X - V)
        onward = _onward(system, k, u[k])
        estimate, X, V = onward @ estimate, onward @ X @ onward.T, onward @ V @ onward.T
        X[:n, :n] += system.Q[k]
        yield row | _estimate("predicted", estimate, X - V)


def _estimate(of: str, estimate: Array, error: Array) -> dict[str, Array]:
    """The part of (x, 1) that is not known."""
    return {f"{of}_state": estimate[:-1], f"{of}_covariance": error[:-1, :-1]}


def _onward(system: LinearSystem, k: int, u: Array) -> Array:
    """What takes (x, 1) from sample k to sample k + 1."""
    n = system.nx
    onward = np.eye(n + 1)
    onward[:n, :n], onward[:n, n] = system.A[k], system.B[k] @ u
    return onward


@dataclass(frozen=True, eq=False, kw_only=True)
class _Measurement:
    """One y = G h (x, 1) + v by its moments.

    `h` is [C, D u]; `gain` and `persistence` are the diagonals of E[G] and Pi, `pair` holds
    E[G_i G_j] and `noise` is E[T R T].
    """

    h: Array
    gain: Array
    persistence: Array
    pair: Array
    noise: Array


def _measurements(system: LinearSystem, moments: FaultMoments, u: Array) -> list[_Measurement]:
    faulty, noise = moments.faulty(system.ny), moments.noise(system.R)
    either = np.maximum(faulty[:, None], faulty)
    return [
        _Measurement(
            h=np.column_stack([system.C[k], system.D[k] @ u[k]]),
            gain=gamma * faulty + 1.0 - faulty,
            persistence=p11 * faulty + 1.0 - faulty,
            pair=gamma * either + 1.0 - either,
            noise=noise[k],
        )
        for k, (gamma, p11) in enumerate(zip(moments.gamma, moments.persistence, strict=True))
    ]


def _update(
    m: _Measurement, predicted: Array, second: tuple[Array, Array], y: Array
) -> tuple[dict[str, Array], Array, Array]:
    """Eq. (22)-(23e) for (x, 1): what is reported, the estimate and its second moment.

    `second` are E[x x'] and E[xhat xhat'] before the measurement, C_(k+1) and A V_k A' of (23).
    """
    X, V = second
    n = len(predicted) - 1
    finite = np.isfinite(y)
    y_y = m.pair * (m.h @ X @ m.h.T) + m.noise
    x_y, xhat_y = X @ m.h.T * m.gain, V @ m.h.T * m.persistence
    expected = m.persistence[:, None] * m.h
    innovation = y_y - expected @ V @ expected.T
    F2 = np.zeros((n + 1, len(y)))  # a missing row has no gain; the constant needs no correction
    F2[:n, finite] = (x_y - xhat_y)[:n, finite] @ scaled_pseudo_inverse(
        innovation[np.ix_(finite, finite)]
    )
    F1 = np.eye(n + 1) - F2 @ expected
    cross = F1 @ xhat_y @ F2.T
    updated = F1 @ V @ F1.T + F2 @ y_y @ F2.T + cross + cross.T
    row = {
        "map": F1,
        "measurement_gain": F2[:n],
        "innovation": y - expected @ predicted,
        "innovation_covariance": innovation,
    }
    return row, F1 @ predicted + F2 @ np.where(finite, y, 0.0), updated


def _require_zero_mean(system: LinearSystem, moments: FaultMoments, u: Array) -> None:
    """Refuse a constant part in y that Lemma 2 does not cover."""
    constant = np.abs(moments.persistence - moments.gamma).max(initial=0.0) <= SAME_PROBABILITY
    driven = (system.B @ u[:, :, None]).any() or (system.D @ u[:, :, None]).any()
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
    """Mean square error of a linear filter with given gains under a chain of modes, exactly.

    Second moments of (x, xhat, 1) are carried for each mode at the present sample.

    Shapes: gains (T, n, n) and (T, n, p); u (T, q); offset (T, n); returns (T, n, n).
    """
    require_sensor_faults_only(system, FaultMoments.from_law(law, system.length))
    T, n, (F1, F2), u = system.length, system.nx, gains, system.inputs(u)
    shift = np.zeros((T, n)) if offset is None else offset
    by_mode = law.initial[:, None, None] * _start(system)
    error = np.hstack([np.eye(n), -np.eye(n), np.zeros((n, 1))])
    onward, covariance = np.eye(2 * n + 1), np.empty((T, n, n))
    for k in range(T):
        for mode in range(4):
            C, D, R = mode_plant(system, law, k, mode)
            estimate = np.column_stack([F2[k] @ C, F1[k], F2[k] @ D @ u[k] + shift[k]])
            by_mode[mode] = _updated(by_mode[mode], estimate, F2[k] @ R @ F2[k].T)
        covariance[k] = error @ by_mode.sum(axis=0) @ error.T
        onward[:n, :n], onward[:n, -1] = system.A[k], system.B[k] @ u[k]
        by_mode = onward @ np.einsum("ij,iab->jab", law.kernel, by_mode) @ onward.T
        by_mode[:, :n, :n] += by_mode[:, -1:, -1:] * system.Q[k]
    return covariance


def _start(system: LinearSystem) -> Array:
    """Second moments of (x, xhat, 1) before sample 0: the estimate is x0."""
    start = np.concatenate([system.x0, system.x0, [1.0]])
    second = np.outer(start, start)
    second[: system.nx, : system.nx] += system.P0
    return second


def _updated(second: Array, estimate: Array, noise: Array) -> Array:
    """Second moments of (x, xhat, 1) once xhat is ``estimate`` @ (x, xhat, 1) and noise."""
    n = len(estimate)
    update = np.eye(2 * n + 1)
    update[n:-1] = estimate
    updated = update @ second @ update.T
    updated[n:-1, n:-1] += second[-1, -1] * noise
    return updated
