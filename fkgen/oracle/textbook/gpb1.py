"""One-step optimal filter by the textbook, eq. (3)-(10).

Full matrices, probabilities in the log domain. `fkgen.oracle.exact.enumeration` is its judge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from fkgen.oracle.exact.gaussian import Array
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.plants.sensor import SensorLaw, mode_plant
from fkgen.oracle.textbook.mixture import (
    Gaussian,
    bayes,
    estimates,
    log,
    matched,
    merge,
    stacked,
    step_law,
    within,
)


@dataclass(frozen=True, eq=False, kw_only=True)
class OneStepResult:
    """Estimates of the one-step filter; names and times as the ports of the family."""

    #: filtered_state, filtered_covariance: (T, n), (T, n, n): x(k|k) and its covariance
    filtered_state: Array
    filtered_covariance: Array
    #: predicted_state, predicted_covariance: (T, n), (T, n, n): x(k+1|k) and its covariance
    predicted_state: Array
    predicted_covariance: Array
    #: innovation, innovation_covariance: (T, p), (T, p, p): y[k] against the mixture of the
    #: modes weighted with Pr(mode at k | y[0..k-1]), all rows; NaN where y is
    innovation: Array
    innovation_covariance: Array
    nis: Array  # nis, log_likelihood: (T,): Of the finite rows; 0 if there are none
    log_likelihood: Array
    #: mode_probability, predicted_mode_probability: (T, N): Law of the mode at k and at k+1
    #: given y[0..k]
    mode_probability: Array
    predicted_mode_probability: Array


def textbook_one_step(
    system: LinearSystem,
    law: SensorLaw,
    y: Array,
    u: Array | None,
    *,
    covariance: Literal["moment_matched", "weighted", "paper", "paper_nominal"] = "moment_matched",
) -> OneStepResult:
    """Run the one-step near-optimal filter, eq. (3)-(10), with x(k|k-1) and P(k|k-1) in eq. (9).

    Shapes: y (T, p); u (T, q).
    """
    u = system.inputs(u)
    priors: list[Gaussian] = [(system.x0, system.P0)] * 4
    log_held, rows = log(law.initial), []
    for k in range(len(y)):
        modes = [
            matched(mode_plant(system, law, k, mode), priors[mode], y[k], u[k]) for mode in range(4)
        ]
        log_posterior, row = bayes(log_held, modes, y[k])
        estimate = merge(log_posterior, [m.filtered for m in modes])
        if covariance != "moment_matched":
            estimate = estimate[0], within(log_posterior, [m.filtered for m in modes])
        ahead = _predict(system, k, estimate, u[k])
        if covariance in {"moment_matched", "weighted"}:
            priors = [ahead] * 4
        else:
            errors = _paper_covariances(system, law, k, [P for _, P in priors], y[k])
            which = (0, 0, 0, 0) if covariance == "paper_nominal" else (0, 1, 0, 1)  # delta
            priors = [(ahead[0], errors[delta]) for delta in which]
        log_held = step_law(log_posterior, law.kernel)
        rows.append({**row, **estimates(estimate, ahead, log_posterior, log_held)})
    return OneStepResult(**stacked(rows))


def _paper_covariances(
    system: LinearSystem, law: SensorLaw, k: int, priors: list[Array], y: Array
) -> list[Array]:
    """Eq. (7) to the letter: P(k+1|k) for delta = 1 and C, as if that were the only fault."""
    finite = np.isfinite(y)
    ahead = []
    for mode in (0, 1):
        C, _, R = mode_plant(system, law, k, mode)
        C, R, P = C[finite], R[np.ix_(finite, finite)], priors[mode]
        F2 = np.linalg.solve(C @ P @ C.T + R, C @ P).T
        after = (np.eye(system.nx) - F2 @ C) @ P
        ahead.append(system.A[k] @ after @ system.A[k].T + system.Q[k])
    return ahead


def _predict(system: LinearSystem, k: int, filtered: Gaussian, u: Array) -> Gaussian:
    """Eq. (1): from x(k|k) to x(k+1|k)."""
    A, B = system.A[k], system.B[k]
    return A @ filtered[0] + B @ u, A @ filtered[1] @ A.T + system.Q[k]
