"""The best linear estimate from its definition: one joint distribution, then projections.

No recursion over time takes place: every estimate conditions anew on all measurements up to its
sample. This is the judge of every Kalman-type recursion with actuator faults, for correlated and
time-varying noise alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fkgen.oracle.exact.gaussian import (
    RANK_TOLERANCE,
    Array,
    Whitening,
    log_density,
    square_root,
    whiten,
)
from fkgen.oracle.plants.actuator import LinearSystem


@dataclass(frozen=True, eq=False, kw_only=True)
class Joint:
    """Means and covariance roots of all states and measurements of a record.

    All are linear in one vector z of uncorrelated unit variances: x[0], then gamma, v and w of each
    sample.
    """

    #: state_mean, state_root: (T + 1, n), (T + 1, n, d): x[k] = state_mean[k] + state_root[k] @
    #: z
    state_mean: Array
    state_root: Array
    #: measurement_mean, measurement_root: (T, p), (T, p, d): y[k] = measurement_mean[k] +
    #: measurement_root[k] @ z
    measurement_mean: Array
    measurement_root: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class BatchResult:
    """Linear minimum-variance estimates of one record; names and times as the ports of a filter."""

    #: filtered_state, filtered_covariance: (T, n), (T, n, n): x(k|k) and its error covariance
    filtered_state: Array
    filtered_covariance: Array
    #: predicted_state, predicted_covariance: (T, n), (T, n, n): x(k+1|k) and its error
    #: covariance
    predicted_state: Array
    predicted_covariance: Array
    innovation: Array  # (T, p): y[k] - E[y[k] | y[0..k-1]]; NaN where y is
    innovation_covariance: Array  # (T, p, p): Covariance of y[k] given the past, all rows
    #: nis, log_likelihood: (T,): Normalised square and Gaussian log density of the innovation,
    #: finite rows only; 0 if there are none
    nis: Array
    log_likelihood: Array


def joint_distribution(system: LinearSystem, u: Array | None) -> Joint:
    """Write all states and measurements of a record in terms of what is random in it, eq. (1)-(3).

    Shapes: u (T, q).
    """
    T, n, p, q = system.length, system.nx, system.ny, system.nu
    u = system.inputs(u)
    size = n + T * (q + n + p)
    state_mean, state_root = np.zeros((T + 1, n)), np.zeros((T + 1, n, size))
    measurement_mean, measurement_root = np.zeros((T, p)), np.zeros((T, p, size))
    fault_root, state_noise, measurement_noise = map(
        square_root, (system.fault_covariance, system.Q, system.R)
    )
    state_mean[0], state_root[0, :, :n] = system.x0, square_root(system.P0)
    for k in range(T):
        start = n + k * (q + n + p)
        applied = np.zeros((q, size))  # (gamma - rate) u: the same in both lines of eq. (1)
        applied[:, start : start + q] = u[k][:, None] * fault_root[k]
        expected = system.rate[k] * u[k]
        measurement_mean[k] = system.C[k] @ state_mean[k] + system.D[k] @ expected
        measurement_root[k] = system.C[k] @ state_root[k] + system.D[k] @ applied
        measurement_root[k, :, start + q + n : start + q + n + p] += measurement_noise[k]
        state_mean[k + 1] = system.A[k] @ state_mean[k] + system.B[k] @ expected
        state_root[k + 1] = system.A[k] @ state_root[k] + system.B[k] @ applied
        state_root[k + 1, :, start + q : start + q + n] += state_noise[k]
    return Joint(
        state_mean=state_mean,
        state_root=state_root,
        measurement_mean=measurement_mean,
        measurement_root=measurement_root,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class _History:
    """What the finite measurements up to some sample say about z."""

    whitening: Whitening
    coordinates: Array

    def mean(self, mean: Array, root: Array) -> Array:
        estimate: Array = mean + root @ (self.whitening.directions @ self.coordinates)
        return estimate

    def root(self, root: Array) -> Array:
        return self.whitening.unexplained(root)


def _history(joint: Joint, y: Array, samples: int) -> _History:
    """Condition on the finite entries of y[0], ..., y[samples - 1]."""
    finite = np.isfinite(y[:samples])
    root = joint.measurement_root[:samples][finite]
    whitening = whiten(root)
    residual = (y[:samples] - joint.measurement_mean[:samples])[finite]
    return _History(whitening=whitening, coordinates=whitening.weights @ residual)


def batch_lmmse(system: LinearSystem, y: Array, u: Array | None) -> BatchResult:
    """Estimate each state by projecting it on all measurements up to its time.

    Where the joint covariance is singular the projection is the one on its range, with the rank
    decided on rows of unit variance.

    Shapes: y (T, p); u (T, q).
    """
    T, n, p = system.length, system.nx, system.ny
    joint = joint_distribution(system, u)
    result = BatchResult(
        filtered_state=np.empty((T, n)),
        filtered_covariance=np.empty((T, n, n)),
        predicted_state=np.empty((T, n)),
        predicted_covariance=np.empty((T, n, n)),
        innovation=np.empty((T, p)),
        innovation_covariance=np.empty((T, p, p)),
        nis=np.zeros(T),
        log_likelihood=np.zeros(T),
    )
    history = _history(joint, y, 0)
    for k in range(T):
        _record_innovation(result, joint, history, y[k], k)
        history = _history(joint, y, k + 1)
        result.filtered_state[k] = history.mean(joint.state_mean[k], joint.state_root[k])
        result.filtered_covariance[k] = _covariance(history.root(joint.state_root[k]))
        result.predicted_state[k] = history.mean(joint.state_mean[k + 1], joint.state_root[k + 1])
        result.predicted_covariance[k] = _covariance(history.root(joint.state_root[k + 1]))
    return result


def _record_innovation(result: BatchResult, joint: Joint, past: _History, y: Array, k: int) -> None:
    """Fill in row k of the innovation and of what follows from it, given the past."""
    before = joint.measurement_root[k]
    root = past.root(before)
    innovation = y - past.mean(joint.measurement_mean[k], before)
    result.innovation[k] = innovation
    result.innovation_covariance[k] = _covariance(root)
    finite = np.isfinite(y)
    if finite.any():
        # What is left of a row that the past determines is rounding of the row as it was.
        dust = RANK_TOLERANCE * np.linalg.norm(before[finite], axis=1)
        whitening = whiten(root[finite], negligible=dust)
        result.nis[k] = np.sum((whitening.weights @ innovation[finite]) ** 2)
        result.log_likelihood[k] = log_density(innovation[finite], whitening)


def _covariance(root: Array) -> Array:
    """Square a root."""
    covariance: Array = root @ root.T
    return covariance
