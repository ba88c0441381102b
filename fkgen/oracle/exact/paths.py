"""The best linear estimate of a jumping plant by brute force: every path of modes, no recursion.

Random variables are vectors, their inner product is the second moment: all paths, given which
states are linear in white noise, stand side by side, scaled by the root of their probability.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from fkgen.oracle.exact.batch import BatchResult, Joint, Judged, project
from fkgen.oracle.exact.gaussian import Array, square_root
from fkgen.oracle.plants.jump import JumpSystem
from fkgen.oracle.textbook.loss_tests import LossTest, verdict


@dataclass(frozen=True, eq=False, kw_only=True)
class JumpResult(BatchResult):
    """Estimates of a jumping plant; zeros where there is no test for losses, or no row."""

    mode_law: Array  # (T, N): Unconditional law of mode[k]
    fault_declared: Array  # (T,), as all that follows: what the test for losses says
    test_statistic: Array
    test_threshold: Array
    test_dof: Array
    consecutive_rejections: Array


def enumerate_paths(
    system: JumpSystem, y: Array, u: Array, test: LossTest | None = None
) -> JumpResult:
    """Project every state on all measurements up to its sample; y, u (T, p), (T, q)."""
    joint, law, R = _joint(system, u)

    def judge(k: int, residual: Array, S: Array) -> Judged:
        verdicts, restart = verdict(test, y[k], residual, S, R[k])
        lost = slice(k + 1 - int(verdicts["fault_declared"]), k + 1)
        return {"mode_law": law[k], **verdicts}, slice(k + 1) if restart else lost

    return JumpResult.of(project(joint, y, judge))


def _paths(transitions: Array, initial: Array, T: int) -> tuple[Array, Array]:
    """Every path of T states of a chain with its probability; impossible ones are left out."""
    paths = np.array(list(itertools.product(range(len(initial)), repeat=T)))
    steps = transitions[np.arange(T - 1), paths[:, :-1], paths[:, 1:]]
    chance = initial[paths[:, 0]] * steps.prod(axis=1)
    return paths[chance > 0.0], chance[chance > 0.0]


def _joint(system: JumpSystem, u: Array) -> tuple[Joint, Array, Array]:
    """States and measurements over all paths; law of the modes (T, N), mean R of y (T, p, p)."""
    T, n, p = system.length, system.nx, system.ny
    paths, chance = _paths(system.transitions, system.initial, T)
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
    law = np.einsum("m,mki->ki", chance, (paths[:, :, None] == np.arange(system.count)) * 1.0)
    R = np.einsum("ki,kiab->kab", law, system.R)
    y, padding = _received(system, signal, square_root(R))
    wide = np.pad(root, ((0, 0), (0, padding)))
    joint = Joint(
        state_mean=np.zeros((T + 1, n)),
        state_root=wide[1 : 1 + (T + 1) * n].reshape(T + 1, n, -1),
        measurement_mean=np.zeros((T, p)),
        measurement_root=y,
        known=wide[:1],
    )
    return joint, law, R


def _received(system: JumpSystem, signal: Array, noise: Array) -> tuple[Array, int]:
    """Measurements gamma s + v: gamma less its mean, times s, is orthogonal to s."""
    T, p, width = signal.shape
    paths, chance = _paths(system.channel, system.arrival_initial, T)
    mean = chance @ paths
    root = np.linalg.qr((paths - mean) * np.sqrt(chance)[:, None]).R.T
    e = root.shape[1]
    y = np.zeros((T, p, width * (1 + e) + T * p))
    for k in range(T):
        y[k, :, :width] = mean[k] * signal[k]
        varied = root[k][None, :, None] * signal[k][:, None, :]
        y[k, :, width : width * (1 + e)] = varied.reshape(p, -1)
        at = width * (1 + e) + k * p
        y[k, :, at : at + p] = noise[k]
    return y, width * e + T * p
