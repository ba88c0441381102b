"""Can the faults be told: rates, hypotheses, their likelihood and the floor of their weights."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from fkgen.spec import evaluate
from fkgen.study.examinations.figures import Figures
from fkgen.study.examinations.findings import Finding, Part
from fkgen.symbolic.bank import LARGEST_MIXTURE

#: Together the floors should leave the probabilities free.
_LARGEST_FLOOR = 1e-2


def known_rate(figures: Figures) -> Part:
    """Rates of 0 and 1, and D = 0, for ``mkf``."""
    spec, faults = figures.spec, figures.spec.faults.actuator
    if spec.filter.family != "mkf" or faults is None:
        return Part()
    rates = [evaluate(rate, spec.defaults) for rate in faults.success_rate]
    values = {f"success_rate.{i}": rate for i, rate in enumerate(rates)}
    findings = [
        Finding(
            "certain_rate",
            "note",
            f"success rate {rate:g}: nothing is random; the filter is a Kalman filter "
            + ("with" if rate == 1.0 else "without")
            + " that input",
            rate,
        )
        for rate in dict.fromkeys(rates)
        if rate in {0.0, 1.0}
    ]
    if not figures.D.any():
        message = (
            "D = 0: y[k] does not show the fault of sample k, which acts as process noise B N B'"
        )
        findings.append(Finding("no_feedthrough", "note", message))
    return Part(tuple(findings), values)


def hypotheses(figures: Figures) -> Part:
    """Hypotheses of ``mme`` that are the same, mirrored, or certain."""
    spec = figures.spec
    if spec.filter.family != "mme":
        return Part()
    findings = []
    for a, b in combinations(spec.filter.hypotheses, 2):
        names = f"{_shown(a)} and {_shown(b)}"
        if a == b:
            message = f"hypotheses {names} are the same: their probabilities never part"
            findings.append(Finding("same_hypotheses", "warning", message, a[0], "drop one"))
        elif all(x == y or abs(x + y - 1.0) < 1e-12 for x, y in zip(a, b, strict=True)):
            message = (
                f"hypotheses {names} have the same covariances: only the mean, rate times u, tells "
                "them apart"
            )
            findings.append(Finding("mirrored_hypotheses", "note", message, a[0]))
    for each, prior in zip(spec.filter.hypotheses, spec.filter.prior, strict=True):
        if {0.0, 1.0} & set(each):
            message = f"hypothesis {_shown(each)} is certain: a plain Kalman filter for that input"
            findings.append(Finding("certain_rate", "note", message, each[0]))
        if prior == 0.0 and spec.filter.weight_floor == 0.0:
            message = (
                f"hypothesis {_shown(each)} has prior 0 and no floor: it never comes into play"
            )
            remedy = "a prior above 0, or a weight_floor"
            findings.append(Finding("dead_hypothesis", "warning", message, 0.0, remedy))
    return Part(tuple(findings), {"hypotheses": float(len(spec.filter.hypotheses))})


def _shown(rates: tuple[float, ...]) -> str:
    return (
        "(" + ", ".join(f"{rate:g}" for rate in rates) + ")" if len(rates) > 1 else f"{rates[0]:g}"
    )


def identification(figures: Figures) -> Part:
    """Whether and how fast y can tell the hypotheses apart."""
    spec, faults = figures.spec, figures.spec.faults.actuator
    if spec.filter.family != "mme" or faults is None:
        return Part()
    message = "while u = 0 the probabilities do not move: identification needs inputs"
    findings = [Finding("needs_input", "note", message)]
    independent = faults.dependence == "independent" and spec.model.nu > LARGEST_MIXTURE
    if figures.D.any():
        if independent and spec.filter.likelihood == "mixture":
            message = (
                f"{spec.model.nu} independent inputs, at most {LARGEST_MIXTURE} for the mixture "
                "likelihood: the Gaussian is used, which is overconfident at first"
            )
            remedy = 'say likelihood = "gaussian" if that is meant'
            finding = Finding("gaussian_likelihood", "warning", message, spec.model.nu, remedy)
            findings.append(finding)
        return Part(tuple(findings))
    if not _inputs_reach_outputs(figures):
        message = "the inputs never reach y: no measurement tells one hypothesis from another"
        remedy = "measure something that the inputs drive"
        return Part((Finding("unidentifiable", "error", message, None, remedy),))
    slow = (
        "D = 0: the rate shows only through the state, so the hypotheses part slowly; that they "
        "never do, as the paper has it, is not so"
    )
    findings.append(
        Finding("slow_identification", "warning", slow, None, "measure the input behind the fault")
    )
    same = "D = 0: mixture and Gaussian likelihood are the same"
    findings.append(Finding("no_feedthrough", "note", same))
    return Part(tuple(findings))


def _inputs_reach_outputs(figures: Figures) -> bool:
    """Whether any Markov parameter C A^k B differs from zero."""
    reached = np.abs(figures.B)
    for _ in range(len(figures.A)):
        if (np.abs(figures.C) @ reached).any():
            return True
        reached = np.abs(figures.A) @ reached
    return False


def floor(figures: Figures) -> Part:
    """The floor under the weights of ``mme``."""
    options = figures.spec.filter
    if options.family != "mme":
        return Part()
    total = len(options.hypotheses) * options.weight_floor
    values = {"weight_floor_total": total}
    if options.weight_floor == 0.0:
        message = (
            "weight_floor = 0, as in the paper: a probability that has gone does not return, so a "
            "change of the rate is not followed"
        )
        remedy = "the default 1e-6 follows changes"
        return Part((Finding("no_weight_floor", "note", message, 0.0, remedy),), values)
    if total > _LARGEST_FLOOR:
        message = (
            f"the floors under {len(options.hypotheses)} hypotheses add up to {total:.3g}: the "
            "probabilities cannot settle"
        )
        remedy = "a weight_floor near 1e-6"
        return Part((Finding("high_weight_floor", "warning", message, total, remedy),), values)
    return Part((), values)
