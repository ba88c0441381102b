"""Where a jumping plant and its filter come to rest: powers of an operator, a Riccati equation."""

from __future__ import annotations

import numpy as np

from fkgen.closed_form.gaussian import Array
from fkgen.closed_form.jump import JumpSystem
from fkgen.closed_form.jump_textbook import SteadyState, split_at, start_of
from fkgen.closed_form.riccati import stationary_prediction_by_control

#: Powers of two of the moment operator after which it has stopped to change, at the latest.
DOUBLINGS = 60


def moment_operator(system: JumpSystem) -> Array:
    """The matrix that moves the second moments of (x, 1) 1{mode}, all blocks stacked."""
    N, n, P = system.count, system.nx, system.transition
    A, Q = np.zeros((2, N, n + 1, n + 1))
    A[:, :n, :n], A[:, :n, n], A[:, n, n] = system.A[0], system.c[0], 1.0
    Q[:, :n, :n] = system.Q[0]
    corner = np.zeros((n + 1) ** 2)
    corner[-1] = 1.0
    each = [np.kron(A[i], A[i]) + np.outer(Q[i].ravel(), corner) for i in range(N)]
    whole: Array = np.block([[P[i, j] * each[i] for i in range(N)] for j in range(N)])
    return whole


def limiting_moments(system: JumpSystem) -> Array:
    """Second moments of (x, 1) 1{mode} after 2, 4, 8, ... steps until nothing changes."""
    N, m = system.count, system.nx + 1
    power, start = moment_operator(system), start_of(system)[1]
    moments = start
    for _ in range(DOUBLINGS):
        power = power @ power
        later = (power @ start.ravel()).reshape(N, m, m)
        mass = later[:, -1, -1].sum()  # probabilities sum to one, but for rounding
        power, later = power / mass, later / mass
        change = np.abs(later - moments).max()
        moments = 0.5 * (later + later.transpose(0, 2, 1))
        if change <= 1e-14 * np.abs(moments).max():
            break
    return moments


def stationary_jumps(system: JumpSystem, rate: float = 1.0) -> SteadyState | None:
    """Find the limits of moments, covariance and gain; None if the equation has no solution.

    Parameters
    ----------
    system : JumpSystem
        Mean-square stable, without inputs, its chain ergodic; its first sample is taken.
    rate : float
        Pr(gamma = 1) as far as only that is known of gamma.
    """
    N, m = system.count, system.nx + 1
    moments = limiting_moments(system)
    split = split_at(system, np.zeros((1, 0)), 0, moments, moments[:, -1, -1])
    # The indicators sum to one: the last follows from the others, and so does its error.
    size = N * m
    drop = np.eye(size - 1, size)
    lift = drop.T.copy()
    lift[-1, m - 1 : size - 1 : m] = -1.0
    F, L = drop @ split.F @ lift, rate * split.L @ lift
    R = split.R + rate * (1.0 - rate) * split.signal
    noise = drop @ split.noise @ drop.T
    found = stationary_prediction_by_control(F, L, 0.5 * (noise + noise.T), R)
    if found is None:
        return None
    X = lift @ found[0] @ lift.T
    S = split.innovation_covariance(X, rate)
    return SteadyState(
        split=split,
        covariance=X,
        innovation_covariance=S,
        gain=rate * X @ split.L.T @ np.linalg.pinv(S, rcond=1e-13, hermitian=True),
        closed_loop_radius=_radius(system, F - F @ found[0] @ L.T @ np.linalg.pinv(S) @ L),
    )


def _radius(system: JumpSystem, loop: Array) -> float:
    """Spectral radius of the error; that of the indicators counts only if something is added."""
    m = system.nx + 1
    kept = np.ones(len(loop), bool) if system.c.any() else np.arange(len(loop)) % m < system.nx
    return float(np.abs(np.linalg.eigvals(loop[np.ix_(kept, kept)])).max())
