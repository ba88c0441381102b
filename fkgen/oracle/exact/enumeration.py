"""The exact posterior of a plant with modes: one Kalman filter per history of the modes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError
from fkgen.oracle.exact.batch import Estimates
from fkgen.oracle.exact.gaussian import Array, mixture
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.plants.jump import JumpSystem
from fkgen.oracle.plants.sensor import SensorLaw, sensed_modes

#: Up to so many histories are enumerated: six samples of four modes.
MOST_HISTORIES = 4**6


@dataclass(frozen=True, eq=False, kw_only=True)
class EnumerationResult(Estimates):
    """Exact conditional moments of one record, eq. (3)."""

    log_likelihood: Array  # (T,): log p(y[k] | y[0..k-1]) of the finite rows; 0 if there are none
    mode_probability: Array  # (T, N): Law of the mode at k, and at k+1, given y[0..k]
    predicted_mode_probability: Array
    #: (T, N, n), (T, N, n, n): x[k] given y[0..k] and the mode at k; NaN where that mode has no
    #: probability
    mode_filtered_state: Array
    mode_filtered_covariance: Array


@dataclass(frozen=True, eq=False)
class _Histories:
    """M sequences of modes up to some sample, and the Kalman filters that know them."""

    mode: NDArray[np.intp]  # (M,): The last of each
    log_weight: Array  # (M,): Log of the probability given the measurements, but for a constant
    state: Array  # (M, n), (M, n, n): Predicted or filtered
    covariance: Array

    def moments(self, N: int) -> dict[str, Array]:
        """Moments given the measurements so far, together and mode by mode."""
        from scipy.special import softmax  # noqa: PLC0415 - slow to import

        n = self.state.shape[1]
        probability, mean = np.zeros(N), np.full((N, n), np.nan)
        covariance = np.full((N, n, n), np.nan)
        for mode in np.unique(self.mode):
            of = self.mode == mode
            probability[mode] = np.exp(self.log_weight[of]).sum()
            mean[mode], covariance[mode] = mixture(
                softmax(self.log_weight[of]), self.state[of], self.covariance[of]
            )
        whole = mixture(softmax(self.log_weight), self.state, self.covariance)
        return {
            "filtered_state": whole[0],
            "filtered_covariance": whole[1],
            "mode_probability": probability,
            "mode_filtered_state": mean,
            "mode_filtered_covariance": covariance,
        }


def enumerate_modes(
    system: LinearSystem, law: SensorLaw, y: Array, u: Array | None
) -> EnumerationResult:
    """Sum over all histories of the conditions of a sensor; y (T, p), u (T, q)."""
    return enumerate_jumps(sensed_modes(system, law), y, system.inputs(u))


def enumerate_jumps(system: JumpSystem, y: Array, u: Array) -> EnumerationResult:
    """Sum over all histories of the modes that have a probability; y, u (T, p), (T, q).

    Given a history its Kalman filter is exact: the posterior is their mixture by evidence.
    """
    T, N = system.length, system.count
    mode = np.flatnonzero(system.initial > 0.0)
    if len(mode) * N ** (T - 1) > MOST_HISTORIES:
        longest = next(t for t in range(T, 0, -1) if len(mode) * N ** (t - 1) <= MOST_HISTORIES)
        raise DataError("y", given=f"{T} samples", expected=f"at most {longest}")
    prior = [each[mode] for each in system.priors]
    histories, rows = _Histories(mode, np.log(system.initial[mode]), *prior), []
    for k in range(T):
        histories, row = _update(system, k, histories, y[k], u[k])
        row |= histories.moments(N)
        histories = _successors(system, k, histories, u[k])
        ahead = histories.moments(N)
        row |= {f"predicted_{of}": ahead[f"filtered_{of}"] for of in ("state", "covariance")}
        rows.append(row | {"predicted_mode_probability": ahead["mode_probability"]})
    return EnumerationResult.of(rows)


def _update(
    system: JumpSystem, k: int, prior: _Histories, y: Array, u: Array
) -> tuple[_Histories, dict[str, Array]]:
    """Update all Kalman filters with the finite rows of y; the ports of the measurement."""
    from scipy.special import log_softmax, logsumexp, softmax  # noqa: PLC0415 - slow to import

    C, D, R, d = (each[k][prior.mode] for each in (system.C, system.D, system.R, system.d))
    x, P = prior.state, prior.covariance
    expected = (C @ x[..., None])[..., 0] + D @ u + d
    S = C @ P @ C.transpose(0, 2, 1) + R
    mean, covariance = mixture(softmax(prior.log_weight), expected, S)
    finite = np.isfinite(y)
    factor = np.linalg.cholesky(S[:, finite][:, :, finite])
    white = np.linalg.solve(factor, (y - expected)[:, finite, None])
    gain = np.linalg.solve(factor, C[:, finite] @ P)
    constant = finite.sum() * np.log(2.0 * np.pi)
    constant += 2.0 * np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
    logs = prior.log_weight - 0.5 * (constant + (white**2).sum(axis=(1, 2)))
    back = gain.transpose(0, 2, 1)
    ports = {
        "innovation": y - mean,
        "innovation_covariance": covariance,
        "log_likelihood": np.array(logsumexp(logs)),
    }
    # Where the logs are huge their differences have more digits than their sum.
    weights = log_softmax(logs)
    return _Histories(prior.mode, weights, x + (back @ white)[..., 0], P - back @ gain), ports


def _successors(system: JumpSystem, k: int, now: _Histories, u: Array) -> _Histories:
    """Prolong every history by every mode that has a probability, which moves it."""
    chance = system.transitions[k][now.mode]
    of, mode = np.nonzero(chance > 0.0)
    A, B, c, Q = (each[k][mode] for each in (system.A, system.B, system.c, system.Q))
    return _Histories(
        mode,
        now.log_weight[of] + np.log(chance[of, mode]),
        (A @ now.state[of][..., None])[..., 0] + B @ u + c,
        A @ now.covariance[of] @ A.transpose(0, 2, 1) + Q,
    )
