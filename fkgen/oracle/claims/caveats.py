"""Where filters of faulty sensors are approximations, and by how much."""

from __future__ import annotations

import numpy as np

from fkgen.oracle import (
    FaultMoments,
    LinearSystem,
    SensorLaw,
    linear_optimal,
    satisfies_lemma_2,
    true_covariance,
)
from fkgen.oracle.claims.sensor import lemma_2_holds
from fkgen.problem import Spec
from fkgen.problem.finding import Finding

#: Samples after which the errors are compared.
HORIZON = 200

#: Probabilities closer than this are the same.
EQUAL = 1e-12

REMEDY = 'filter.form = "augmented", the best linear filter for any Markov gamma, or family = "imm"'


def lemma_2(spec: Spec) -> tuple[Finding, ...]:
    """Sigalov & Oshman, Lemma 2: without it (23) is neither the LMMSE nor knows its error."""
    faults = spec.faults.sensor
    if faults is None or spec.filter.form != "lemma2" or lemma_2_holds(spec):
        return ()
    if faults.moments is not None or satisfies_lemma_2(*_law(spec))[0]:
        reason = (
            "some rows of y never fail, and gamma depends on its past: their signal does not carry"
            " gamma, so it predicts the others with E[gamma], not with p11"
        )
    else:
        difference = satisfies_lemma_2(*_law(spec))[1]
        reason = (
            "Pr(gamma_k = 1 | gamma_i = 1) is not the same for all i < k, it differs by up to"
            f" {difference:.3g} (for a Markov gamma, either p11 = 1 or equal rows are needed)"
        )
    message = (
        f"Lemma 2 fails: {reason}; the estimate is not the best linear one and its covariance not"
        " that of its error"
    )
    believed, true = _errors(spec)
    if true is None or believed is None:
        return (Finding("lemma-2", "warning", message, None, REMEDY),)
    message += (
        f": after {HORIZON} samples it believes a mean square error of {believed:.4g} (trace), the"
        f" true one is {true:.4g}"
    )
    return (Finding("lemma-2", "warning", message, true, REMEDY),)


def _law(spec: Spec) -> tuple[np.ndarray, np.ndarray]:
    law = SensorLaw.from_spec(spec)
    return law.kernel, law.initial


def _errors(spec: Spec) -> tuple[float | None, float | None]:
    """Trace of the believed and of the true error covariance, where both can be computed."""
    faults = spec.faults.sensor
    if faults is None or not faults.kernel:
        return None, None
    with np.errstate(all="ignore"):
        system = LinearSystem.from_spec(spec, HORIZON)
        y = np.zeros((HORIZON, spec.model.ny))
        found = linear_optimal(system, FaultMoments.from_spec(spec, HORIZON), y, None)
        gains = found.state_gain, found.measurement_gain
        true = true_covariance(system, SensorLaw.from_spec(spec), gains)
    believed, actual = (float(np.trace(P[-1])) for P in (found.filtered_covariance, true))
    second = float(np.trace(found.state_second_moment[-1]))
    if not (np.isfinite(actual) and believed > 0.0 and second * 1e-9 < believed):
        return None, None  # an unstable plant: C - V has cancelled
    return believed, actual


def three_modes(spec: Spec) -> tuple[Finding, ...]:
    """Three modes for four events, which is exact for a lumpable chain only: sec. III and IV."""
    faults = spec.faults.sensor
    if faults is None or spec.filter.modes != 3 or faults.noise_factor == 1.0:
        return ()
    defect = faults.lumped().defect
    if defect <= EQUAL:
        return ()
    message = (
        "three modes are not Markov here: delta at gamma = 0 depends on the past or tells about the"
        f" future, and treating it as drawn anew is wrong by up to {defect:.3g} in the probability"
        " of a step"
    )
    return (Finding("three-modes", "warning", message, defect, "modes = 4"),)
