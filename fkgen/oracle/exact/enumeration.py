"""The exact posterior of a plant with modes: one Kalman filter per history of the modes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fkgen.errors import DataError
from fkgen.oracle.exact.gaussian import Array
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.plants.jump import JumpSystem
from fkgen.oracle.plants.sensor import SensorLaw, sensed_modes

#: Up to so many histories are enumerated: six samples of four modes.
MOST_HISTORIES = 4**6


@dataclass(frozen=True, eq=False, kw_only=True)
class EnumerationResult:
    """Exact conditional moments of one record; names and times as the ports of a filter."""

    #: filtered_state, filtered_covariance: (T, n), (T, n, n): Mean and covariance of x[k] given
    #: y[0..k], eq. (3)
    filtered_state: Array
    filtered_covariance: Array
    #: predicted_state, predicted_covariance: (T, n), (T, n, n): The same of x[k+1]
    predicted_state: Array
    predicted_covariance: Array
    #: innovation, innovation_covariance: (T, p), (T, p, p): y[k] - E[y[k] | y[0..k-1]], NaN
    #: where y is, and its covariance, all rows
    innovation: Array
    innovation_covariance: Array
    log_likelihood: Array  # (T,): log p(y[k] | y[0..k-1]) of the finite rows; 0 if there are none
    #: mode_probability, predicted_mode_probability: (T, N): Law of the mode at k and at k+1
    #: given y[0..k]
    mode_probability: Array
    predicted_mode_probability: Array
    #: mode_filtered_state, mode_filtered_covariance: (T, N, n), (T, N, n, n): Mean and
    #: covariance of x[k] given y[0..k] and the mode at k; NaN where that mode has no
    #: probability
    mode_filtered_state: Array
    mode_filtered_covariance: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class _History:
    """One sequence of modes up to some sample.

    `log_weight` is the log of its probability given the measurements so far, but for a constant;
    `state` and `covariance` are those of the Kalman filter that knows the modes, predicted or
    filtered.
    """

    mode: int
    log_weight: float
    state: Array
    covariance: Array


def enumerate_modes(
    system: LinearSystem, law: SensorLaw, y: Array, u: Array | None
) -> EnumerationResult:
    """Sum over all histories of the conditions of a sensor.

    Shapes: y (T, p); u (T, q).
    """
    return enumerate_jumps(sensed_modes(system, law), y, system.inputs(u))


def enumerate_jumps(system: JumpSystem, y: Array, u: Array) -> EnumerationResult:
    """Sum over all histories of the modes that have a probability.

    Given a history the plant is linear and Gaussian, so its Kalman filter is exact, and the
    posterior is the mixture of the filters weighted with prior probability times evidence.

    Shapes: y, u (T, p), (T, q).
    """
    _refuse_long(system)
    T, N = system.length, system.count
    histories = _branches(0.0, system.initial, [(system.x0, system.P0)] * N)
    rows = []
    for k in range(T):
        plants = [(system.C[k, i], system.D[k, i], system.R[k, i]) for i in range(N)]
        expected = _expected(histories, plants, u[k])
        histories = [_filtered(h, plants[h.mode], y[k], u[k]) for h in histories]
        histories, log_likelihood = _normalised(histories)
        now = _moments(histories, N)
        histories = _successors(system, k, u[k], histories)
        ahead = _moments(histories, N)
        rows.append(
            now
            | {
                "predicted_state": ahead["filtered_state"],
                "predicted_covariance": ahead["filtered_covariance"],
                "innovation": y[k] - expected[0],
                "innovation_covariance": expected[1],
                "log_likelihood": np.array(log_likelihood),
                "predicted_mode_probability": ahead["mode_probability"],
            }
        )
    return EnumerationResult(**{name: np.array([row[name] for row in rows]) for name in rows[0]})


def _refuse_long(system: JumpSystem) -> None:
    T, N = system.length, system.count
    starts = np.count_nonzero(system.initial)
    if starts * N ** (T - 1) > MOST_HISTORIES:
        longest = next(t for t in range(T, 0, -1) if starts * N ** (t - 1) <= MOST_HISTORIES)
        raise DataError("y", given=f"{T} samples", expected=f"at most {longest}")


def _branches(log_weight: float, law: Array, moments: list[tuple[Array, Array]]) -> list[_History]:
    """A history prolonged by every mode that has a probability, with what it leads to."""
    return [
        _History(mode=j, log_weight=log_weight + float(np.log(law[j])), state=x, covariance=P)
        for j, (x, P) in enumerate(moments)
        if law[j] > 0.0
    ]


def _successors(system: JumpSystem, k: int, u: Array, histories: list[_History]) -> list[_History]:
    """Prolong every history by every mode, which moves it."""
    longer = []
    for h in histories:
        moved = [
            (A @ h.state + B @ u + c, A @ h.covariance @ A.T + Q)
            for A, B, c, Q in zip(system.A[k], system.B[k], system.c[k], system.Q[k], strict=True)
        ]
        longer += _branches(h.log_weight, system.transition[h.mode], moved)
    return longer


def _filtered(history: _History, plant: tuple[Array, Array, Array], y: Array, u: Array) -> _History:
    """Update the Kalman filter of a history with the finite rows of y."""
    finite = np.isfinite(y)
    C, D, R = plant[0][finite], plant[1][finite], plant[2][np.ix_(finite, finite)]
    x, P = history.state, history.covariance
    factor = np.linalg.cholesky(C @ P @ C.T + R)
    white = np.linalg.solve(factor, y[finite] - C @ x - D @ u)
    gain = np.linalg.solve(factor, C @ P)
    constant = finite.sum() * np.log(2.0 * np.pi) + 2.0 * np.log(np.diag(factor)).sum()
    return _History(
        mode=history.mode,
        log_weight=history.log_weight - 0.5 * float(constant + white @ white),
        state=x + gain.T @ white,
        covariance=P - gain.T @ gain,
    )


def _mixture(log_weights: Array, means: Array, covariances: Array) -> tuple[Array, Array]:
    """Mean and covariance of a Gaussian mixture."""
    from scipy.special import softmax  # noqa: PLC0415 - slow to import

    weights = softmax(log_weights)
    mean = weights @ means
    spread = means - mean
    within = np.einsum("i,ijk->jk", weights, covariances)
    return mean, within + np.einsum("i,ij,ik->jk", weights, spread, spread)


def _normalised(histories: list[_History]) -> tuple[list[_History], float]:
    """Let the weights add up to one, and return the log of what they added up to."""
    from scipy.special import log_softmax, logsumexp  # noqa: PLC0415 - slow to import

    logs = np.array([h.log_weight for h in histories])
    # Where the logs are huge their differences have more digits than their sum.
    pairs = zip(histories, log_softmax(logs), strict=True)
    return [replace(h, log_weight=float(log)) for h, log in pairs], float(logsumexp(logs))


def _moments(histories: list[_History], N: int) -> dict[str, Array]:
    """Moments given the measurements so far."""
    modes = np.array([h.mode for h in histories])
    logs = np.array([h.log_weight for h in histories])
    means = np.array([h.state for h in histories])
    covariances = np.array([h.covariance for h in histories])
    n = means.shape[1]
    probability, mode_mean = np.zeros(N), np.full((N, n), np.nan)
    mode_covariance = np.full((N, n, n), np.nan)
    for mode in np.unique(modes):
        member = modes == mode
        probability[mode] = np.exp(logs[member]).sum()
        mode_mean[mode], mode_covariance[mode] = _mixture(
            logs[member], means[member], covariances[member]
        )
    mean, covariance = _mixture(logs, means, covariances)
    return {
        "filtered_state": mean,
        "filtered_covariance": covariance,
        "mode_probability": probability,
        "mode_filtered_state": mode_mean,
        "mode_filtered_covariance": mode_covariance,
    }


def _expected(
    histories: list[_History], plants: list[tuple[Array, Array, Array]], u: Array
) -> tuple[Array, Array]:
    """Mean and covariance of the next measurement, all rows."""
    pairs = [(h, plants[h.mode]) for h in histories]
    return _mixture(
        np.array([h.log_weight for h in histories]),
        np.array([C @ h.state + D @ u for h, (C, D, _) in pairs]),
        np.array([C @ h.covariance @ C.T + R for h, (C, _, R) in pairs]),
    )
