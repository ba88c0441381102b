"""The best linear estimate under sensor faults from its definition: joint moments, projections.

Nothing of Lemma 2 is used: this judges the recursion (23), also where the lemma fails.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fkgen.errors import DataError
from fkgen.oracle.exact.batch import BatchResult, Joint, joint_distribution, project
from fkgen.oracle.exact.gaussian import Array, square_root
from fkgen.oracle.exact.moments import FaultMoments
from fkgen.oracle.plants.actuator import LinearSystem


def joint_moments(
    system: LinearSystem, moments: FaultMoments, u: Array | None
) -> tuple[Array, Array]:
    """Mean and covariance of all states and measurements, one pair of times after another."""
    require_sensor_faults_only(system, moments)
    T, n, p = system.length, system.nx, system.ny
    u = system.inputs(u)
    state_mean, state = _states(system, u)
    split = (T + 1) * n
    mean, covariance = np.zeros(split + T * p), np.zeros((split + T * p,) * 2)
    mean[:split] = state_mean.ravel()
    covariance[:split, :split] = state.transpose(0, 2, 1, 3).reshape(split, split)
    signal = np.array(
        [system.C[k] @ state_mean[k] + system.D[k] @ u[k] + system.d[k] for k in range(T)]
    )
    gain, noise, faulty = moments.gains(p), moments.noise(system.R), moments.faulty(p)
    mean[split:] = (gain * signal).ravel()
    for k in range(T):
        at = slice(split + k * p, split + (k + 1) * p)
        cross = (state[:, k] @ system.C[k].T * gain[k]).reshape(split, p)
        covariance[:split, at], covariance[at, :split] = cross, cross.T
        for i in range(T):
            # E[G_k G_i] entry by entry: one gamma in all rows that fail, 1 in the others.
            fails = moments.gamma_pair[k, i] - moments.gamma[k] * moments.gamma[i]
            both = np.outer(gain[k], gain[i]) + fails * np.outer(faulty, faulty)
            block = both * (system.C[k] @ state[k, i] @ system.C[i].T)
            block += fails * np.outer(faulty * signal[k], faulty * signal[i])
            covariance[at, split + i * p : split + (i + 1) * p] = block + (k == i) * noise[k]
    return mean, covariance


def _states(system: LinearSystem, u: Array) -> tuple[Array, Array]:
    """Mean of each x[k], (T + 1, n), and covariance of each pair, (T + 1, T + 1, n, n)."""
    T, n = system.length, system.nx
    mean, covariance = np.zeros((T + 1, n)), np.zeros((T + 1, T + 1, n, n))
    mean[0], covariance[0, 0] = system.x0, system.P0
    for k in range(T):
        A = system.A[k]
        mean[k + 1] = A @ mean[k] + system.B[k] @ u[k] + system.c[k]
        for i in range(k + 1):
            covariance[k + 1, i] = A @ covariance[k, i]
            covariance[i, k + 1] = covariance[k + 1, i].T
        covariance[k + 1, k + 1] = A @ covariance[k, k] @ A.T + system.Q[k]
    return mean, covariance


def joint_uncertain(system: LinearSystem, moments: FaultMoments, u: Array | None) -> Joint:
    """Roots of the same joint covariance, which keep the digits of small error variances.

    With gamma = E[gamma] + L e a measurement is linear in z, e and all e_a z_b, which are white.
    """
    require_sensor_faults_only(system, moments)
    T, n, p = system.length, system.nx, system.ny
    signal = joint_distribution(replace(system, R=np.zeros_like(system.R)), u)
    size = signal.state_root.shape[-1]
    z = signal.measurement_root.reshape(T * p, size)
    gain = moments.gains(p).reshape(T * p, 1)
    e = np.repeat(moments.gamma_root, p, axis=0) * np.tile(moments.faulty(p), T)[:, None]
    e = e[:, e.any(axis=0)]
    roots = square_root(moments.noise(system.R))
    measurements = [
        gain * z,
        e * signal.measurement_mean.reshape(T * p, 1),
        (e[:, :, None] * z[:, None, z.any(axis=0)]).reshape(T * p, -1),
        np.einsum("kij,kl->kilj", roots, np.eye(T)).reshape(T * p, T * p),
    ]
    states = signal.state_root.reshape((T + 1) * n, size)
    width = sum(part.shape[1] for part in measurements)
    # The same vectors in as few coordinates as they need.
    whole = np.vstack([np.pad(states, ((0, 0), (0, width - size))), np.hstack(measurements)])
    root = np.linalg.qr(whole.T).R.T
    return Joint(
        state_mean=signal.state_mean,
        state_root=root[: (T + 1) * n].reshape(T + 1, n, -1),
        measurement_mean=moments.gains(p) * signal.measurement_mean,
        measurement_root=root[(T + 1) * n :].reshape(T, p, -1),
    )


def batch_uncertain(
    system: LinearSystem, moments: FaultMoments, y: Array, u: Array | None
) -> BatchResult:
    """Project each state on all measurements up to its time; y (T, p), u (T, q)."""
    return BatchResult.of(project(joint_uncertain(system, moments, u), y))


def require_sensor_faults_only(system: LinearSystem, moments: FaultMoments) -> None:
    """Refuse a plant whose actuators fail too, and moments of another number of samples."""
    if system.fault_covariance.any() or (system.rate != 1.0).any():
        raise DataError("actuators", given="faults", expected="sensor faults only")
    if moments.length != system.length:
        raise DataError(
            "moments of gamma",
            given=f"{moments.length} samples",
            expected=f"{system.length}, as the plant has",
        )
