"""One sample of the modified Kalman filter (MKF) in the paper's matrices, eq. (4), (9)-(15).

Full matrices, a pseudo-inverse and SciPy's densities, judged by `fkgen.oracle.exact.batch` in turn.
"""

from __future__ import annotations

import numpy as np

from fkgen.oracle.exact.gaussian import Array, units
from fkgen.oracle.plants import actuator
from fkgen.oracle.plants.actuator import LinearSystem

#: Directions of a correlation matrix below this are rounding and left out of its inverse.
PSEUDO_INVERSE_CUTOFF = 1e-13

#: Independent inputs up to which the mixture runs over all 2^q states of the actuators.
MIXTURE_INPUTS = 4


def scaled_pseudo_inverse(covariance: Array) -> Array:
    """Pseudo-inverse of a covariance (m, m) with the rank decided on its correlation matrix."""
    scale = np.outer(units(covariance), units(covariance))
    inverse = np.linalg.pinv(covariance / scale, rcond=PSEUDO_INVERSE_CUTOFF, hermitian=True)
    return np.asarray(inverse / scale)


def textbook_step(
    system: LinearSystem, k: int, prediction: tuple[Array, Array], y: Array, u: Array
) -> dict[str, Array]:
    """Filter and predict sample k by eq. (4), (11) and the stabilised form (9), and expect y, (21).

    Shapes: prediction (n,) and (n, n); y (p,); u (q,).
    """
    x, P = prediction
    A, B, C, D = system.A[k], system.B[k], system.C[k], system.D[k]
    N = np.diag(u) @ system.fault_covariance[k] @ np.diag(u)
    worked = system.rate[k] * u
    expected = C @ x + D @ worked + system.d[k]
    covariance = C @ P @ C.T + D @ N @ D.T + system.R[k]
    finite = np.isfinite(y)
    Cf, Df, Rf = C[finite], D[finite], system.R[k][np.ix_(finite, finite)]
    innovation = (y - expected)[finite]
    inverse = scaled_pseudo_inverse(covariance[np.ix_(finite, finite)])
    Kf = P @ Cf.T @ inverse
    K = (A @ P @ Cf.T + B @ N @ Df.T) @ inverse
    E, F, G = np.eye(x.size) - Kf @ Cf, A - K @ Cf, B - K @ Df
    return {
        "filtered_state": x + Kf @ innovation,
        "filtered_covariance": E @ P @ E.T + Kf @ (Df @ N @ Df.T + Rf) @ Kf.T,
        "predicted_state": A @ x + B @ worked + system.c[k] + K @ innovation,
        "predicted_covariance": F @ P @ F.T + G @ N @ G.T + system.Q[k] + K @ Rf @ K.T,
        "expected_measurement": expected,
        "innovation_covariance": covariance,
    }


def log_likelihood(
    system: LinearSystem,
    k: int,
    prediction: tuple[Array, Array],
    y: Array,
    u: Array,
    *,
    mixture: bool,
) -> float:
    """Log of p(y[k] | Y[k-1], xi_i) over the finite rows; shapes as above."""
    from scipy.special import logsumexp  # noqa: PLC0415 - slow to import

    x, P = prediction
    finite = np.isfinite(y)
    C, D, rate = system.C[k][finite], system.D[k][finite], system.rate[k]
    residual = y[finite] - system.d[k][finite] - C @ x
    noise = C @ P @ C.T + system.R[k][np.ix_(finite, finite)]
    patterns = patterns_of(rate, system.fault_covariance[k]) if mixture else None
    if patterns is None:
        N = np.diag(u) @ system.fault_covariance[k] @ np.diag(u)
        return _log_normal(residual - D @ (rate * u), noise + D @ N @ D.T)
    densities = [_log_normal(residual - D @ (pattern * u), noise) for pattern in patterns[0]]
    return float(logsumexp(densities, b=patterns[1]))


def patterns_of(rate: Array, covariance: Array) -> tuple[Array, Array] | None:
    """States of the actuators and their probabilities; None where they are not enumerated."""
    if rate.size == 0:
        return None
    if rate.size == 1 or (actuator.is_common(rate, covariance) and covariance.any()):
        return actuator.common_patterns(rate)
    if actuator.is_independent(covariance) and rate.size <= MIXTURE_INPUTS:
        return actuator.independent_patterns(rate)
    return None


def _log_normal(residual: Array, covariance: Array) -> float:
    """Log of eq. (15) by SciPy, on unit variances so that units do not decide the rank."""
    from scipy.stats import Covariance, multivariate_normal  # noqa: PLC0415 - slow to import

    if residual.size == 0:
        return 0.0
    deviation = units(covariance)
    correlation = covariance / np.outer(deviation, deviation)
    try:
        # SciPy would call a correlation matrix of condition 1e10 singular; its factor is not.
        shape = Covariance.from_cholesky(np.linalg.cholesky(correlation))
    except np.linalg.LinAlgError:
        shape = correlation
    density = multivariate_normal.logpdf(residual / deviation, cov=shape, allow_singular=True)
    return float(density - np.log(deviation).sum())
