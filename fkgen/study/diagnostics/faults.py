"""Can the faults be told apart, what does their law say, and what does it leave of the filter."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from fkgen.estimators.models.bank import LARGEST_MIXTURE
from fkgen.families import family
from fkgen.faults import ActuatorFaults
from fkgen.oracle.claims.compression import design_of
from fkgen.oracle.exact.partial_compression import partial_compression
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.problem import evaluate
from fkgen.problem.probability import stationary_law, visited
from fkgen.study.diagnostics.findings import ReportBuilder
from fkgen.study.diagnostics.model_numbers import Array, ModelNumbers, listed
from fkgen.study.diagnostics.visibility import reaches

#: Together the floors should leave the probabilities free.
_LARGEST_FLOOR = 1e-2
_MODES = ("(1,1)", "(1,C)", "(0,1)", "(0,C)")
#: Rates, and rows of a transition matrix, closer than this are equal.
_EQUAL = 1e-12
#: Windows beyond which nobody waits for a number.
_LONGEST = 500
#: A variance that is so much larger is worth a word.
_MUCH = 0.1


def known_rate(model: ModelNumbers, report: ReportBuilder) -> None:
    """Rates of 0 and 1, and D = 0, for ``mkf``."""
    spec, faults = model.spec, model.spec.faults.actuator
    if faults is None or spec.first_rates is not None:
        return
    rates = [evaluate(rate, spec.defaults) for rate in faults.success_rate]
    report.values |= {f"success_rate.{i}": rate for i, rate in enumerate(rates)}
    for rate in dict.fromkeys(rates):
        if rate in {0.0, 1.0}:
            message = f"success rate {rate:g}: nothing is random; the filter is a Kalman filter "
            message += f"{'with' if rate == 1.0 else 'without'} that input"
            report.note("certain_rate", message, rate)
    if not model.D.any():
        message = (
            "D = 0: y[k] does not show the fault of sample k, which acts as process noise B N B'"
        )
        report.note("no_feedthrough", message)


def hypotheses(model: ModelNumbers, report: ReportBuilder) -> None:
    """Success rates of a bank of filters: can they be told apart, by what, and for how long."""
    spec, faults = model.spec, model.spec.faults.actuator
    if faults is not None and spec.first_rates is not None:
        _alike(spec.filter.options, report)
        _identification(model, faults, report)
        _floor(spec.filter.options, report)


def _alike(options: Any, report: ReportBuilder) -> None:
    """Hypotheses that are the same, mirrored, or certain."""
    report.values["hypotheses"] = float(len(options.hypotheses))
    for a, b in combinations(options.hypotheses, 2):
        names = f"{_shown(a)} and {_shown(b)}"
        if a == b:
            message = f"hypotheses {names} are the same: their probabilities never part"
            report.warning("same_hypotheses", message, a[0], "drop one")
        elif all(x == y or abs(x + y - 1.0) < _EQUAL for x, y in zip(a, b, strict=True)):
            message = (
                f"hypotheses {names} have the same covariances: only the mean, rate times u, tells "
                "them apart"
            )
            report.note("mirrored_hypotheses", message, a[0])
    for each, prior in zip(options.hypotheses, options.prior, strict=True):
        if {0.0, 1.0} & set(each):
            message = f"hypothesis {_shown(each)} is certain: a plain Kalman filter for that input"
            report.note("certain_rate", message, each[0])
        if prior == 0.0 and options.weight_floor == 0.0:
            message = (
                f"hypothesis {_shown(each)} has prior 0 and no floor: it never comes into play"
            )
            report.warning("dead_hypothesis", message, 0.0, "a prior above 0, or a weight_floor")


def _shown(rates: tuple[float, ...]) -> str:
    text = ", ".join(f"{rate:g}" for rate in rates)
    return f"({text})" if len(rates) > 1 else text


def _identification(model: ModelNumbers, faults: ActuatorFaults, report: ReportBuilder) -> None:
    """Whether and how fast y can tell the hypotheses apart."""
    spec = model.spec
    if not model.D.any() and not any(reaches(model, j) for j in range(spec.model.nu)):
        message = "the inputs never reach y: no measurement tells one hypothesis from another"
        report.error("unidentifiable", message, None, "measure something that the inputs drive")
        return
    message = "while u = 0 the probabilities do not move: identification needs inputs"
    report.note("needs_input", message)
    if model.D.any():
        independent = faults.dependence == "independent" and spec.model.nu > LARGEST_MIXTURE
        if independent and spec.filter.options.likelihood == "mixture":
            message = (
                f"{spec.model.nu} independent inputs, at most {LARGEST_MIXTURE} for the mixture "
                "likelihood: the Gaussian is used, which is overconfident at first"
            )
            remedy = 'say likelihood = "gaussian" if that is meant'
            report.warning("gaussian_likelihood", message, spec.model.nu, remedy)
        return
    slow = (
        "D = 0: the rate shows only through the state, so the hypotheses part slowly; that they "
        "never do, as the paper has it, is not so"
    )
    report.warning("slow_identification", slow, None, "measure the input behind the fault")
    report.note("no_feedthrough", "D = 0: mixture and Gaussian likelihood are the same")


def _floor(options: Any, report: ReportBuilder) -> None:
    """The floor under the weights."""
    total = len(options.hypotheses) * options.weight_floor
    report.values["weight_floor_total"] = total
    if options.weight_floor == 0.0:
        message = (
            "weight_floor = 0, as in the paper: a probability that has gone does not return, so a "
            "change of the rate is not followed"
        )
        report.note("no_weight_floor", message, 0.0, "the default 1e-6 follows changes")
    if total > _LARGEST_FLOOR:
        message = (
            f"the floors under {len(options.hypotheses)} hypotheses add up to {total:.3g}: the "
            "probabilities cannot settle"
        )
        report.warning("high_weight_floor", message, total, "a weight_floor near 1e-6")


def caveats(model: ModelNumbers, report: ReportBuilder) -> None:
    """Where the filter is less than its name says: what its family knows about that."""
    report.findings.extend(family(model.spec.filter.family).caveats(model.spec))


def noise_factor(model: ModelNumbers, report: ReportBuilder) -> None:
    """A factor below one, or one that makes delta meaningless."""
    if model.spec.faults.sensor is None:
        return
    factor = model.spec.faults.sensor.noise_factor
    report.values["noise_factor"] = factor
    if factor < 1.0:
        message = (
            f"noise_factor = {factor:g} is below 1: the fault delta = C makes the sensor better"
        )
        remedy = "state R of the better condition, and a factor above 1"
        report.warning("noise_factor", message, factor, remedy)


def distribution(model: ModelNumbers, report: ReportBuilder) -> None:
    """Rates at the start and in the long run; modes that never come; modes of no memory."""
    faults = model.spec.faults.sensor
    if faults is None or not faults.kernel:
        return
    kernel, initial = np.array(faults.kernel), np.array(faults.initial)
    for mode, p in zip(_MODES, initial, strict=True):
        report.values[f"initial_probability.{mode}"] = float(p)
    lasting = stationary_law(kernel)
    if lasting is not None:
        report.values["gamma_rate"] = float(lasting[:2].sum())
        report.values["delta_nominal_rate"] = float(lasting[[0, 2]].sum())
    never = [mode for mode, seen in zip(_MODES, visited(kernel, initial), strict=True) if not seen]
    if never:
        message = f"the modes {listed(never)} never come: their probability is exactly zero"
        remedy = "another initial, or a kernel that leads there, if they can happen"
        report.note("impossible_mode", message, len(never), remedy)
    if model.spec.filter.traits.models == "mixed" and np.ptp(kernel, axis=0).max() <= _EQUAL:
        message = "the rows of the kernel are equal: imm gives what one_step gives, at more cost"
        report.note("no_memory", message, None, 'family = "one_step" is cheaper')


def lost_signal(model: ModelNumbers, report: ReportBuilder) -> None:
    """An unstable plant under a linear filter: the second moment of the state acts as noise."""
    spec, faults = model.spec, model.spec.faults.sensor
    if faults is None or not spec.filter.traits.moments:
        return
    if faults.moments is not None:
        rate = faults.moments.gamma_rate
    else:
        rate, lasting = sum(faults.initial[:2]), stationary_law(faults.kernel)
        rate = rate if lasting is None else min(rate, float(lasting[:2].sum()))
    radius = float(np.abs(np.linalg.eigvals(model.A)).max())
    if rate < 1.0 - _EQUAL and radius >= 1.0:
        message = (
            f"the plant is not stable (radius {radius:.4g}) and E[gamma] = {rate:.4g} is below 1: a"
            " lost signal counts as noise of the size of the state, which grows, and the error of a"
            " linear filter with it"
        )
        report.warning("unstable_linear", message, radius, 'family = "imm" or "one_step"')


def compression_loss(model: ModelNumbers, report: ReportBuilder) -> None:
    """Variance after the first window over that of a Kalman filter, all rows at every sample."""
    spec, soft = model.spec, model.spec.faults.soft
    if spec.filter.traits.windows != "partial" or soft is None or soft.window > _LONGEST:
        return
    system = LinearSystem.from_spec(spec, soft.window + 1)
    design = replace(design_of(spec, soft.window), false_alarm=None)
    y, u = np.zeros((system.length, system.ny)), np.zeros((system.length, system.nu))
    compressed = np.diag(partial_compression(system, design, y, u).filtered_covariance[-1])
    kalman = np.diag(_filtered(system))
    ratio = np.divide(compressed, kalman, out=np.ones_like(kalman), where=kalman > 0.0)
    worst = int(np.argmax(ratio))
    loss = float(ratio[worst]) - 1.0
    report.values["compression_loss"] = loss
    if loss > _MUCH:
        message = (
            f"the variance of {model.states[worst]} after the first window is {loss:.0%}"
            " above that of dfcf, which loses nothing (all rows at every sample)"
        )
        remedy = 'family = "dfcf", or a shorter window'
        if spec.filter.options.maintenance == "paper":
            remedy = f'maintenance = "optimal", {remedy}'
        report.warning("compression_loss", message, loss, remedy)


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
