"""The best linear estimate of a jumping plant by brute force: every path of modes, no recursion.

Random variables are vectors, their inner product is the second moment, and an estimate is the
projection on the span of 1 and all measurements so far. Given the path of the modes, states are
linear in white noise; all paths side by side, each scaled by the root of its probability, give the
exact moments.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from fkgen.oracle.exact.gaussian import RANK_TOLERANCE, Array, log_density, square_root, whiten
from fkgen.oracle.plants.jump import JumpSystem
from fkgen.oracle.textbook.loss_tests import LossTest


@dataclass(frozen=True, eq=False, kw_only=True)
class JumpResult:
    """Estimates of one record; names and times as the ports of a filter."""

    #: filtered_state, filtered_covariance: (T, n), (T, n, n): x(k|k) and its error covariance
    filtered_state: Array
    filtered_covariance: Array
    #: predicted_state, predicted_covariance: (T, n), (T, n, n): x(k+1|k) and its error
    #: covariance
    predicted_state: Array
    predicted_covariance: Array
    innovation: Array  # (T, p): NaN where y is
    innovation_covariance: Array  # (T, p, p): Of all rows, given the past
    nis: Array  # nis, log_likelihood: (T,): Of the finite rows; 0 if there are none
    log_likelihood: Array
    mode_law: Array  # (T, N): Unconditional law of mode[k]
    #: fault_declared, test_statistic, test_threshold, test_dof: (T,): Of the test for losses;
    #: zeros without one, and where there is no row
    fault_declared: Array
    test_statistic: Array
    test_threshold: Array
    test_dof: Array
    consecutive_rejections: Array  # (T,)

    @classmethod
    def blank(cls, T: int, n: int, p: int, mode_law: Array) -> JumpResult:
        """A result to be filled in."""
        scalars = ("nis", "log_likelihood", "fault_declared", "test_statistic", "test_threshold")
        return cls(
            filtered_state=np.empty((T, n)),
            filtered_covariance=np.empty((T, n, n)),
            predicted_state=np.empty((T, n)),
            predicted_covariance=np.empty((T, n, n)),
            innovation=np.empty((T, p)),
            innovation_covariance=np.empty((T, p, p)),
            mode_law=mode_law,
            consecutive_rejections=np.zeros(T),
            test_dof=np.zeros(T),
            **{name: np.zeros(T) for name in scalars},
        )


@dataclass(frozen=True, eq=False)
class _Vectors:
    """Random variables as vectors: the constant 1, states, measurements and their noise."""

    one: Array
    x: Array
    y: Array
    R: Array


def enumerate_paths(
    system: JumpSystem, y: Array, u: Array, test: LossTest | None = None
) -> JumpResult:
    """Project every state on all measurements up to its sample.

    Shapes: y, u (T, p), (T, q).
    """
    T, n, p = system.length, system.nx, system.ny
    vectors = _vectors(system, u)
    result = JumpResult.blank(T, n, p, _marginal_law(system))
    used, runs = y.copy(), _Runs(test)
    for k in range(T):
        past = _Past(vectors, used[:k])
        residual, S, root = past.innovation(k, y[k])
        result.innovation[k], result.innovation_covariance[k] = residual, S
        rows = np.flatnonzero(np.isfinite(y[k]))
        if rows.size:
            # What is left of a row that the past determines is rounding of the row as it was.
            dust = RANK_TOLERANCE * np.linalg.norm(vectors.y[k][rows], axis=1)
            whitening = whiten(root[rows], negligible=dust)
            result.nis[k] = np.sum((whitening.weights @ residual[rows]) ** 2)
            result.log_likelihood[k] = log_density(residual[rows], whitening)
        if test is not None and rows.size:
            chosen = np.ix_(rows, rows)
            statistic, threshold = test.judge(
                y[k][rows], residual[rows], S[chosen], vectors.R[k][chosen]
            )
            fault = statistic > threshold
            result.test_statistic[k], result.test_threshold[k] = statistic, threshold
            result.fault_declared[k], result.test_dof[k] = fault, rows.size
            if fault:
                used[k] = np.nan
            if runs.restarts(fault=fault):
                used[: k + 1] = np.nan  # to start again is to forget
        result.consecutive_rejections[k] = runs.length
        now = _Past(vectors, used[: k + 1])
        result.filtered_state[k], result.filtered_covariance[k] = now.estimate(vectors.x[k])
        result.predicted_state[k], result.predicted_covariance[k] = now.estimate(vectors.x[k + 1])
    return result


class _Runs:
    """Rejections in a row, and when they have become too many."""

    def __init__(self, test: LossTest | None) -> None:
        self.test, self.length = test, 0

    def restarts(self, *, fault: bool) -> bool:
        """Count one test; whether the filter starts again."""
        if self.test is None:
            return False
        options = self.test.options
        if self._locked(options):
            self.length = 0
        self.length = self.length + 1 if fault else 0
        if self._locked(options):
            self.test.energies.clear()
        return self._locked(options)

    def _locked(self, options: Any) -> bool:
        return bool(options.reinitialise and self.length >= options.lock_out)


class _Past:
    """What 1 and the finite measurements so far reveal."""

    def __init__(self, vectors: _Vectors, y: Array) -> None:
        finite = np.isfinite(y)
        self.vectors = vectors
        self.whitening = whiten(np.vstack([vectors.one, vectors.y[: len(y)][finite]]))
        self.coordinates = self.whitening.weights @ np.append(1.0, y[finite])

    def estimate(self, root: Array) -> tuple[Array, Array]:
        """Projection of a vector variable, and the covariance of what is left."""
        rest = self.whitening.unexplained(root)
        return root @ (self.whitening.directions @ self.coordinates), rest @ rest.T

    def innovation(self, k: int, y: Array) -> tuple[Array, Array, Array]:
        """Residual of y[k], its covariance and the root of that."""
        root = self.vectors.y[k]
        mean, covariance = self.estimate(root)
        return y - mean, covariance, self.whitening.unexplained(root)


def _paths(system: JumpSystem) -> tuple[Array, Array]:
    """Every path of T modes with its probability; impossible ones are left out."""
    paths = np.array(list(itertools.product(range(system.count), repeat=system.length)))
    steps = system.transition[paths[:, :-1], paths[:, 1:]].prod(axis=1)
    chance = system.initial[paths[:, 0]] * steps
    return paths[chance > 0.0], chance[chance > 0.0]


def _marginal_law(system: JumpSystem) -> Array:
    paths, chance = _paths(system)
    modes = np.arange(system.count)
    law: Array = np.einsum("m,mki->ki", chance, (paths[:, :, None] == modes).astype(float))
    return law


def _vectors(system: JumpSystem, u: Array) -> _Vectors:
    """States and signals over all paths, then measurements with gamma and their noise."""
    T, n, p = system.length, system.nx, system.ny
    paths, chance = _paths(system)
    M, width = len(paths), 1 + n + n * T
    added, sensed = system.offsets(u)
    noise = square_root(system.Q)
    x, s = np.zeros((T + 1, M, n, width)), np.zeros((T, M, p, width))
    x[0, :, :, 0], x[0, :, :, 1 : 1 + n] = system.x0, square_root(system.P0)
    for k in range(T):
        mode = paths[:, k]
        s[k] = system.C[k][mode] @ x[k]
        s[k, :, :, 0] += sensed[k][mode]
        x[k + 1] = system.A[k][mode] @ x[k]
        x[k + 1, :, :, 0] += added[k][mode]
        at = 1 + n + n * k
        x[k + 1, :, :, at : at + n] += noise[k][mode]
    one = np.zeros((1, M, 1, width))
    one[..., 0] = 1.0
    rows = [part.transpose(0, 2, 1, 3).reshape(-1, M, width) for part in (one, x, s)]
    stacked = np.concatenate(rows) * np.sqrt(chance)[:, None]
    root = np.linalg.qr(stacked.reshape(len(stacked), -1).T).R.T
    signal = root[1 + (T + 1) * n :].reshape(T, p, -1)
    R = np.einsum("ki,kiab->kab", _marginal_law(system), system.R)
    y, padding = _received(signal, *_arrival_moments(system), square_root(R))
    wide = np.pad(root, ((0, 0), (0, padding)))
    return _Vectors(wide[0], wide[1 : 1 + (T + 1) * n].reshape(T + 1, n, -1), y, R)


def _arrival_moments(system: JumpSystem) -> tuple[Array, Array]:
    """E[gamma_k] and a root of Cov(gamma), from all paths of gamma."""
    T = system.length
    paths = np.array(list(itertools.product((0, 1), repeat=T)))
    chance = system.arrival_initial[paths[:, 0]]
    chance = chance * system.arrival[paths[:, :-1], paths[:, 1:]].prod(axis=1)
    mean = chance @ paths
    deviation = (paths - mean) * np.sqrt(chance)[:, None]
    return mean, np.linalg.qr(deviation).R.T


def _received(signal: Array, mean: Array, root: Array, noise: Array) -> tuple[Array, int]:
    """Measurements gamma s + v: gamma less its mean, times s, is orthogonal to s."""
    T, p, width = signal.shape
    e = root.shape[1]
    y = np.zeros((T, p, width * (1 + e) + T * p))
    for k in range(T):
        y[k, :, :width] = mean[k] * signal[k]
        varied = root[k][None, :, None] * signal[k][:, None, :]
        y[k, :, width : width * (1 + e)] = varied.reshape(p, -1)
        at = width * (1 + e) + k * p
        y[k, :, at : at + p] = noise[k]
    return y, width * e + T * p
