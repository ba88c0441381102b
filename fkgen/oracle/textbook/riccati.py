"""Stationary prediction error covariance: the Riccati equation, (12) in the limit, solved twice."""

from __future__ import annotations

import numpy as np

from fkgen.oracle.exact.gaussian import Array
from fkgen.oracle.plants.actuator import LinearSystem

#: A closed loop nearer to the unit circle is not stable: a double eigenvalue on the circle, where
#: no stabilising solution exists, is computed with an error of sqrt(1e-16).
STABILITY_MARGIN = 1e-7

#: Largest relative residual of the equation: a wrong invariant subspace leaves far more.
RESIDUAL_TOLERANCE = 1e-6


def stationary_prediction(
    A: Array, C: Array, Q: Array, R: Array, S: Array | None = None
) -> tuple[Array, float] | None:
    """Solve P = A P A' + Q - (A P C' + S) (C P C' + R)^-1 (A P C' + S)' with SciPy; S (n, p).

    Returns P and the radius of the closed loop, or None: a mode that is neither stable nor seen, or
    one on the unit circle that no noise excites.
    """
    from scipy.linalg import solve_discrete_are  # noqa: PLC0415 - slow to import

    S = np.zeros((len(A), len(C))) if S is None else S
    try:
        H, V, cross = _unit_noise(C, R, S)
        P = solve_discrete_are(A.T, H.T, Q, V, s=cross)
    except (np.linalg.LinAlgError, ValueError):
        return None
    return _accepted(P, A, C, (Q, R, S))


def stationary_prediction_by_control(
    A: Array, C: Array, Q: Array, R: Array, S: Array | None = None
) -> tuple[Array, float] | None:
    """Solve the same equation with python-control; arguments and result as above."""
    import control  # noqa: PLC0415 - slow to import

    S = np.zeros((len(A), len(C))) if S is None else S
    Q, R = 0.5 * (Q + Q.T), 0.5 * (R + R.T)  # it refuses what rounding has left unsymmetric
    try:
        H, V, cross = _unit_noise(C, R, S)
        P, _, _ = control.dare(A.T, H.T, Q, V, cross, np.eye(len(A)))
    except (np.linalg.LinAlgError, ValueError, control.ControlArgument, control.ControlDimension):
        return None
    return _accepted(P, A, C, (Q, R, S))


def _unit_noise(C: Array, R: Array, S: Array) -> tuple[Array, Array, Array]:
    """C, R and S in units in which the noise of every row is 1, where solvers keep their digits."""
    variances = np.diag(R)
    unit = np.sqrt(np.where(variances > 0.0, variances, 1.0))
    return C / unit[:, None], R / np.outer(unit, unit), S / unit


def _accepted(
    P: Array, A: Array, C: Array, noise: tuple[Array, Array, Array]
) -> tuple[Array, float] | None:
    """P and its closed-loop radius if P solves the equation and stabilises, else None."""
    Q, R, S = noise
    P = np.asarray(P, dtype=float)
    if not np.isfinite(P).all():
        return None
    P = 0.5 * (P + P.T)
    cross = A @ P @ C.T + S
    K = cross @ np.linalg.pinv(C @ P @ C.T + R, hermitian=True)
    radius = float(np.abs(np.linalg.eigvals(A - K @ C)).max())
    residual = np.abs(A @ P @ A.T + Q - K @ cross.T - P).max()
    negligible = RESIDUAL_TOLERANCE * np.abs(P).max()
    solved = residual <= negligible and np.linalg.eigvalsh(P).min() >= -negligible
    return (P, radius) if solved and radius < 1.0 - STABILITY_MARGIN else None


def constant_gain(system: LinearSystem, y: Array, u: Array) -> dict[str, Array]:
    """States of an observer with the stationary gain; a missing row adds nothing; {} without one.

    Shapes: y (T, p), u (T, q).
    """
    found = stationary_prediction(*(getattr(system, letter)[0] for letter in "ACQRS"))
    if found is None:
        return {}
    P, C, rows = found[0], system.C[0], []
    S = C @ P @ C.T + system.R[0]
    inverse = np.linalg.pinv(S, hermitian=True)
    K, N, x = P @ C.T @ inverse, system.S[0] @ inverse, system.x0
    for k, now in enumerate(y):
        error = now - (system.C[k] @ x + system.D[k] @ u[k] + system.d[k])
        seen = np.where(np.isnan(error), 0.0, error)
        filtered = x + K @ seen
        x = system.A[k] @ filtered + system.B[k] @ u[k] + system.c[k] + N @ seen
        rows.append((error, filtered, x, S, P, P - K @ S @ K.T))
    names = ("innovation", "filtered_state", "predicted_state")
    covariances = (f"{name}_covariance" for name in ("innovation", "predicted", "filtered"))
    columns = zip(*rows, strict=True)
    return dict(zip((*names, *covariances), map(np.array, columns), strict=True))


def constant_input_noise(system: LinearSystem, u: Array, k: int = 0) -> tuple[Array, Array, Array]:
    """Q, R and S at a constant input (q,): failing actuators shake x and y together, (12), (22)."""
    N = np.outer(u, u) * system.fault_covariance[k]
    B, D = system.B[k], system.D[k]
    return system.Q[k] + B @ N @ B.T, system.R[k] + D @ N @ D.T, system.S[k] + B @ N @ D.T
