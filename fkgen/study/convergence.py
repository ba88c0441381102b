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

from fkgen.study.figures import Figures
from fkgen.study.findings import Finding, Part
from fkgen.study.response import LINEAR
from fkgen.study.size import used_parameters


def condition(figures: Figures) -> Part:
    """Say which condition holds, and gain and norm of the filter at rest."""
    spec, rest = figures.spec, figures.rest
    if rest is None:
        if spec.filter.family not in LINEAR:
            return Part()
        return Part((_only_e("the filter does not come to rest"),))
    values = {
        f"filtered_gain.{state}.{output}": float(rest.filtered_gain[i, j])
        for i, state in enumerate(figures.states)
        for j, output in enumerate(figures.outputs)
    }
    M = (np.eye(len(figures.A)) - rest.filtered_gain @ figures.C) @ figures.A
    values["closed_loop_norm"] = float(np.linalg.norm(M, 2))
    if spec.filter.family not in LINEAR:
        message = (
            f"the gains of {spec.filter.family} depend on the measurements or on the law of their "
            "faults: no condition on its products of gains is known; the figures are those of the "
            "Kalman filter without faults"
        )
        return Part((Finding("error_decay_unknown", "note", message),), values)
    moving = [p.name for p in spec.parameters if p.name in used_parameters(spec)]
    if moving and spec.filter.family != "genie":
        return Part((_only_e("the model changes with its parameters"),), values)
    if spec.filter.family == "genie":
        return Part((_only_e("signals may be lost"),), values)
    constant = " while u is constant" if figures.has_faults else ""
    message = (
        f"the effect of a fault dies away{constant}: M[k] tends to M with rho(M) = "
        f"{rest.radius:.9g} < 1 (condition c); ||M|| = {values['closed_loop_norm']:.4g}"
    )
    if values["closed_loop_norm"] >= 1.0:
        message += ", so it may grow at first"
    return Part((Finding("error_decay", "note", message, rest.radius),), values)


def _only_e(reason: str) -> Finding:
    message = (
        f"{reason}: of the effect of a fault it is only certain that, measured by P(k|k), it never "
        "grows (condition e); that every rho(M[k]) < 1 would prove nothing more"
    )
    remedy = "look at it with fault-effect, over the parameters and inputs that occur"
    return Finding("error_decay_unproved", "note", message, None, remedy)
