"""Can the faults be told: rates, hypotheses, their likelihood and the floor of their weights.

Sensor faults: what their law says, and what it leaves of the filter.

What the partial compression filter loses beside a filter that loses nothing.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np

from fkgen.estimators.models.bank import LARGEST_MIXTURE
from fkgen.families import family
from fkgen.oracle import LinearSystem, partial_compression
from fkgen.oracle.claims.partial_compression import design_of
from fkgen.problem import evaluate
from fkgen.problem.probability import stationary_law, visited
from fkgen.study.diagnostics.findings import Finding, Part
from fkgen.study.diagnostics.model_numbers import Array, Figures, listed

#: Together the floors should leave the probabilities free.
_LARGEST_FLOOR = 1e-2


def known_rate(figures: Figures) -> Part:
    """Rates of 0 and 1, and D = 0, for ``mkf``."""
    spec, faults = figures.spec, figures.spec.faults.actuator
    if faults is None or spec.first_rates is not None:
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
    if spec.first_rates is None:
        return Part()
    findings = []
    for a, b in combinations(spec.filter.options.hypotheses, 2):
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
    for each, prior in zip(spec.filter.options.hypotheses, spec.filter.options.prior, strict=True):
        if {0.0, 1.0} & set(each):
            message = f"hypothesis {_shown(each)} is certain: a plain Kalman filter for that input"
            findings.append(Finding("certain_rate", "note", message, each[0]))
        if prior == 0.0 and spec.filter.options.weight_floor == 0.0:
            message = (
                f"hypothesis {_shown(each)} has prior 0 and no floor: it never comes into play"
            )
            remedy = "a prior above 0, or a weight_floor"
            findings.append(Finding("dead_hypothesis", "warning", message, 0.0, remedy))
    return Part(tuple(findings), {"hypotheses": float(len(spec.filter.options.hypotheses))})


def _shown(rates: tuple[float, ...]) -> str:
    return (
        "(" + ", ".join(f"{rate:g}" for rate in rates) + ")" if len(rates) > 1 else f"{rates[0]:g}"
    )


def identification(figures: Figures) -> Part:
    """Whether and how fast y can tell the hypotheses apart."""
    spec, faults = figures.spec, figures.spec.faults.actuator
    if faults is None or spec.first_rates is None:
        return Part()
    message = "while u = 0 the probabilities do not move: identification needs inputs"
    findings = [Finding("needs_input", "note", message)]
    independent = faults.dependence == "independent" and spec.model.nu > LARGEST_MIXTURE
    if figures.D.any():
        if independent and spec.filter.options.likelihood == "mixture":
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
    options = figures.spec.filter.options
    if figures.spec.first_rates is None:
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


_MODES = ("(1,1)", "(1,C)", "(0,1)", "(0,C)")

#: Rows of a kernel closer than this are equal.
_EQUAL = 1e-12


def caveats(figures: Figures) -> Part:
    """Where the filter is less than its name says: what its family knows about that."""
    spec = figures.spec
    return Part(family(spec.filter.family).caveats(spec))


def noise_factor(figures: Figures) -> Part:
    """A factor below one, or one that makes delta meaningless."""
    faults = figures.spec.faults.sensor
    if faults is None:
        return Part()
    factor = faults.noise_factor
    values = {"noise_factor": factor}
    if factor < 1.0:
        message = (
            f"noise_factor = {factor:g} is below 1: the fault delta = C makes the sensor better"
        )
        remedy = "state R of the better condition, and a factor above 1"
        return Part((Finding("noise_factor", "warning", message, factor, remedy),), values)
    return Part((), values)


def law(figures: Figures) -> Part:
    """Rates at the start and in the long run; modes that never come; modes of no memory."""
    spec, faults = figures.spec, figures.spec.faults.sensor
    if faults is None or not faults.kernel:
        return Part()
    kernel, initial = np.array(faults.kernel), np.array(faults.initial)
    values = {f"initial_probability.{m}": float(p) for m, p in zip(_MODES, initial, strict=True)}
    findings = []
    lasting = stationary_law(kernel)
    if lasting is not None:
        values["gamma_rate"] = float(lasting[:2].sum())
        values["delta_nominal_rate"] = float(lasting[[0, 2]].sum())
    never = [mode for mode, seen in zip(_MODES, visited(kernel, initial), strict=True) if not seen]
    if never:
        message = f"the modes {listed(never)} never come: their probability is exactly zero"
        remedy = "another initial, or a kernel that leads there, if they can happen"
        findings.append(Finding("impossible_mode", "note", message, len(never), remedy))
    if spec.filter.traits.models == "mixed" and np.ptp(kernel, axis=0).max() <= _EQUAL:
        message = "the rows of the kernel are equal: imm gives what one_step gives, at more cost"
        findings.append(
            Finding("no_memory", "note", message, None, 'family = "one_step" is cheaper')
        )
    return Part(tuple(findings), values)


def lost_signal(figures: Figures) -> Part:
    """An unstable plant under a linear filter: the second moment of the state acts as noise."""
    spec, faults = figures.spec, figures.spec.faults.sensor
    if faults is None or not spec.filter.traits.moments:
        return Part()
    rate = faults.moments.gamma_rate if faults.moments is not None else _lowest_rate(figures)
    radius = float(np.abs(np.linalg.eigvals(figures.A)).max())
    if rate >= 1.0 - _EQUAL or radius < 1.0:
        return Part()
    message = (
        f"the plant is not stable (radius {radius:.4g}) and E[gamma] = {rate:.4g} is below 1: a"
        " lost signal counts as noise of the size of the state, which grows, and the error of a"
        " linear filter with it"
    )
    remedy = 'family = "imm" or "one_step"'
    return Part((Finding("unstable_linear", "warning", message, radius, remedy),))


def _lowest_rate(figures: Figures) -> float:
    faults = figures.spec.faults.sensor
    if faults is None:
        return 1.0
    lasting = stationary_law(faults.kernel)
    rates = [sum(faults.initial[:2])]
    return min(rates if lasting is None else [*rates, float(lasting[:2].sum())])


#: Windows beyond which nobody waits for a figure.
_LONGEST = 500

#: A variance that is so much larger is worth a word.
_MUCH = 0.1


def compression_loss(figures: Figures) -> Part:
    """Variance after the first window over that of a Kalman filter, all rows at every sample."""
    spec, soft = figures.spec, figures.spec.faults.soft
    if spec.filter.traits.windows != "partial" or soft is None or soft.window > _LONGEST:
        return Part()
    system = LinearSystem.from_spec(spec, soft.window + 1)
    design = replace(design_of(spec, soft.window), false_alarm=None)
    y, u = np.zeros((system.length, system.ny)), np.zeros((system.length, system.nu))
    compressed = np.diag(partial_compression(system, design, y, u).filtered_covariance[-1])
    kalman = np.diag(_filtered(system))
    ratio = np.divide(compressed, kalman, out=np.ones_like(kalman), where=kalman > 0.0)
    worst = int(np.argmax(ratio))
    loss = float(ratio[worst]) - 1.0
    values = {"compression_loss": loss}
    if loss <= _MUCH:
        return Part((), values)
    message = (
        f"the variance of {spec.model.states[worst].name} after the first window is {loss:.0%}"
        " above that of dfcf, which loses nothing (all rows at every sample)"
    )
    remedy = 'family = "dfcf", or a shorter window'
    if spec.filter.options.maintenance == "paper":
        remedy = f'maintenance = "optimal", {remedy}'
    return Part((Finding("compression_loss", "warning", message, loss, remedy),), values)


def _filtered(system: LinearSystem) -> Array:
    """Covariance of a Kalman filter of all rows after the last sample, in Joseph's form."""
    P = system.P0
    for k in range(system.length):
        if k:
            P = system.A[k - 1] @ P @ system.A[k - 1].T + system.Q[k - 1]
        C, R = system.C[k], system.R[k]
        K = P @ C.T @ np.linalg.pinv(C @ P @ C.T + R, hermitian=True)
        rest = np.eye(system.nx) - K @ C
        P = rest @ P @ rest.T + K @ R @ K.T
    return np.asarray(P)
