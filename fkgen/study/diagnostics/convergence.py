"""Does the effect of a fault die away: which of the sufficient conditions that are true holds.

Song & Hu 2019, Theorem 1 (every rho(M[k]) < 1) is not among them: it is false. What is true, for
M[k] = (I - K[k+1] C[k+1]) A[k]:

a. one norm in which all ||M[k]|| <= q < 1;
b. the joint spectral radius of the set of all M[k] is below 1;
c. M[k] tends to an M with rho(M) < 1: constant data, and a Riccati equation that has a stabilising
   solution;
d. bounded data, (A, C) uniformly detectable, (A, Q^1/2) uniformly stabilisable;
e. always: Delta' P(k|k)^-1 Delta never grows once the fault is over.
"""

from __future__ import annotations

import numpy as np

from fkgen.study.diagnostics.findings import ReportBuilder
from fkgen.study.diagnostics.model_numbers import ModelNumbers, listed
from fkgen.study.diagnostics.size import used_parameters


def condition(model: ModelNumbers, report: ReportBuilder) -> None:
    """Say which condition holds, and gain and norm of the filter in its steady state."""
    spec, steady = model.spec, model.steady
    if steady is None:
        if spec.filter.traits.linear:
            _only_e(report, "the filter does not come to rest")
        return
    for i, state in enumerate(model.states):
        for j, output in enumerate(model.outputs):
            gain = float(steady.filtered_gain[i, j])
            report.values[f"filtered_gain.{state}.{output}"] = gain
    M = (np.eye(len(model.A)) - steady.filtered_gain @ model.C) @ model.A
    norm = float(np.linalg.norm(M, 2))
    report.values["closed_loop_norm"] = norm
    if not spec.filter.traits.linear:
        message = (
            f"the gains of {spec.filter.family} depend on the measurements or on the law of their "
            "faults: no condition on its products of gains is known; the figures are those of the "
            "Kalman filter without faults"
        )
        report.note("error_decay_unknown", message)
        return
    decays = (
        f"the effect of a fault dies away: M[k] tends to M with rho(M) = {steady.radius:.9g} < 1 "
        "(condition c)"
    )
    if norm >= 1.0:
        decays += f", after it may have grown at first: ||M|| = {norm:.4g}"
    if reason := _varying(model):
        _only_e(report, f"{decays}, as long as nothing varies; but {reason}")
    else:
        report.note("error_decay", decays, steady.radius)


def _varying(model: ModelNumbers) -> str:
    """What makes gains vary for ever, if anything does."""
    spec = model.spec
    if spec.filter.traits.told:
        return "signals may be lost"
    moving = [p.name for p in spec.parameters if p.name in used_parameters(spec)]
    if moving:
        return f"the model changes with {listed(moving)}"
    return "the gain changes with u" if model.has_faults else ""


def _only_e(report: ReportBuilder, reason: str) -> None:
    message = (
        f"{reason}: then it is only certain that the effect, measured by P(k|k), never grows once "
        "the fault is over (condition e); that every rho(M[k]) < 1 would prove nothing more"
    )
    remedy = "see fault-effect, over parameters and inputs that occur"
    report.note("error_decay_unproved", message, None, remedy)
