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

from fkgen.study.diagnostics.findings import Finding, Part
from fkgen.study.diagnostics.model_numbers import Figures, listed
from fkgen.study.diagnostics.size import used_parameters


def condition(figures: Figures) -> Part:
    """Say which condition holds, and gain and norm of the filter at rest."""
    spec, rest = figures.spec, figures.rest
    if rest is None:
        if not spec.filter.traits.linear:
            return Part()
        return Part((_only_e("the filter does not come to rest"),))
    values = {
        f"filtered_gain.{state}.{output}": float(rest.filtered_gain[i, j])
        for i, state in enumerate(figures.states)
        for j, output in enumerate(figures.outputs)
    }
    M = (np.eye(len(figures.A)) - rest.filtered_gain @ figures.C) @ figures.A
    values["closed_loop_norm"] = float(np.linalg.norm(M, 2))
    if not spec.filter.traits.linear:
        message = (
            f"the gains of {spec.filter.family} depend on the measurements or on the law of their "
            "faults: no condition on its products of gains is known; the figures are those of the "
            "Kalman filter without faults"
        )
        return Part((Finding("error_decay_unknown", "note", message),), values)
    decays = (
        f"the effect of a fault dies away: M[k] tends to M with rho(M) = {rest.radius:.9g} < 1 "
        "(condition c)"
    )
    if (norm := values["closed_loop_norm"]) >= 1.0:
        decays += f", after it may have grown at first: ||M|| = {norm:.4g}"
    if reason := _varying(figures):
        return Part((_only_e(f"{decays}, as long as nothing varies; but {reason}"),), values)
    return Part((Finding("error_decay", "note", decays, rest.radius),), values)


def _varying(figures: Figures) -> str:
    """What makes gains vary for ever, if anything does."""
    spec = figures.spec
    if spec.filter.traits.told:
        return "signals may be lost"
    moving = [p.name for p in spec.parameters if p.name in used_parameters(spec)]
    if moving:
        return f"the model changes with {listed(moving)}"
    return "the gain changes with u" if figures.has_faults else ""


def _only_e(reason: str) -> Finding:
    message = (
        f"{reason}: then it is only certain that the effect, measured by P(k|k), never grows once "
        "the fault is over (condition e); that every rho(M[k]) < 1 would prove nothing more"
    )
    remedy = "see fault-effect, over parameters and inputs that occur"
    return Finding("error_decay_unproved", "note", message, None, remedy)
