"""Stationary prediction error covariance from the Riccati equation, eq. (12) in the limit.

Solved twice, by SciPy and by python-control; neither walks through time.
"""

from __future__ import annotations

import numpy as np

from fkgen.oracle.exact.gaussian import Array
from fkgen.oracle.plants.actuator import LinearSystem

#: A closed loop nearer to the unit circle than this counts as not stable. A double eigenvalue on
#: the circle, the mark of a mode that no stabilising solution exists for, is computed with an error
#: of sqrt(1e-16).
STABILITY_MARGIN = 1e-7

#: Largest relative residual of the equation in an accepted solution: a wrong invariant subspace
#: leaves far more.
RESIDUAL_TOLERANCE = 1e-6


def stationary_prediction(
    A: Array, C: Array, Q: Array, R: Array, S: Array | None = None
) -> tuple[Array, float] | None:
    """Solve P = A P A' + Q - (A P C' + S) (C P C' + R)^-1 (A P C' + S)' with SciPy.

    Returns None if there is no stabilising solution: a mode that is not stable and not seen in y,
    or one on the unit circle that no noise excites.

    Shapes: A, C (n, n), (p, n); Q, R (n, n), (p, p); S (n, p).
    """
    from scipy.linalg import solve_discrete_are  # noqa: PLC0415 - slow to import

    cross = np.zeros((A.shape[0], C.shape[0])) if S is None else S
    try:
        P = solve_discrete_are(A.T, C.T, Q, R, s=cross)
    except (np.linalg.LinAlgError, ValueError):
        return None
    return _accepted(np.asarray(P, dtype=float), A, C, (Q, R, cross))


def stationary_prediction_by_control(
    A: Array, C: Array, Q: Array, R: Array, S: Array | None = None
) -> tuple[Array, float] | None:
    """Solve the same equation with python-control; arguments and result as `stationary_prediction`.

    Shapes: A, C (n, n), (p, n); Q, R (n, n), (p, p); S (n, p); returns (n, n).
    """
    import control  # noqa: PLC0415 - slow to import

    cross = np.zeros((A.shape[0], C.shape[0])) if S is None else S
    try:
        P, _, _ = control.dare(A.T, C.T, Q, R, cross, np.eye(A.shape[0]))
    except (np.linalg.LinAlgError, ValueError, control.ControlArgument, control.ControlDimension):
        return None
    return _accepted(np.asarray(P, dtype=float), A, C, (Q, R, cross))


def _accepted(
    P: Array, A: Array, C: Array, noise: tuple[Array, Array, Array]
) -> tuple[Array, float] | None:
    """Return P and its closed-loop radius if P solves the equation and stabilises, else None."""
    Q, R, S = noise
    if not np.isfinite(P).all():
        return None
    P = 0.5 * (P + P.T)
    innovation = C @ P @ C.T + R
    cross = A @ P @ C.T + S
    K = cross @ np.linalg.pinv(innovation, hermitian=True)
    radius = float(np.abs(np.linalg.eigvals(A - K @ C)).max())
    residual = np.abs(A @ P @ A.T + Q - K @ cross.T - P).max()
    size = np.abs(P).max()
    solved = residual <= RESIDUAL_TOLERANCE * size
    positive = np.linalg.eigvalsh(P).min() >= -RESIDUAL_TOLERANCE * size
    return (P, radius) if solved and positive and radius < 1.0 - STABILITY_MARGIN else None


def constant_input_noise(system: LinearSystem, u: Array, k: int = 0) -> tuple[Array, Array, Array]:
    """Find the noise at a constant input: failing actuators shake x and y together, eq. (12), (22).

    Shapes: u (q,).
    """
    N = np.outer(u, u) * system.fault_covariance[k]
    B, D = system.B[k], system.D[k]
    return system.Q[k] + B @ N @ B.T, system.R[k] + D @ N @ D.T, B @ N @ D.T
