"""Can the faults be told apart, what does their law say, and what does it leave of the filter."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from fkgen.estimators.models.bank import LARGEST_MIXTURE
from fkgen.faults import ActuatorFaults
from fkgen.oracle.claims.compression import design_of
from fkgen.oracle.exact.partial_compression import partial_compression
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.textbook.mkf import textbook_step
from fkgen.problem import evaluate
from fkgen.problem.probability import stationary_law, visited
from fkgen.study.diagnostics.subject import Subject, listed
from fkgen.study.diagnostics.visibility import reaches

_LARGEST_FLOOR = 1e-2  # together the floors should leave the probabilities free
_MODES = ("(1,1)", "(1,C)", "(0,1)", "(0,C)")
_EQUAL = 1e-12  # rates, and rows of a transition matrix, that are closer are equal
_LONGEST = 500  # windows beyond which nobody waits for a number
_MUCH = 0.1  # a variance that is so much larger is worth a word


def known_rate(model: Subject) -> None:
    """Rates of 0 and 1, and D = 0, for ``mkf``."""
    spec, faults = model.spec, model.spec.faults.actuator
    if faults is None or spec.first_rates is not None:
        return
    rates = [evaluate(rate, spec.defaults) for rate in faults.success_rate]
    model.put("success_rate", range(len(rates)), rates)
    for rate in dict.fromkeys(rates):
        if rate in {0.0, 1.0}:
            model.add("certain_rate", rate, with_="with" if rate == 1.0 else "without")
    if not model.curved and not model.D.any():
        model.add("no_feedthrough")


def hypotheses(model: Subject) -> None:
    """Success rates of a bank of filters: can they be told apart, by what, and for how long."""
    faults, options = model.spec.faults.actuator, model.spec.filter.options
    if faults is None or model.spec.first_rates is None:
        return
    count, floor = len(options.hypotheses), options.weight_floor
    _alike(model, options)
    if not model.curved:
        _identification(model, faults, options.likelihood)
    model.values["weight_floor_total"] = count * floor
    if floor == 0.0:
        model.add("no_weight_floor", 0.0)
    if count * floor > _LARGEST_FLOOR:
        model.add("high_weight_floor", count * floor, count=count)


def _alike(model: Subject, options: Any) -> None:
    """Hypotheses that are the same, mirrored, or certain."""
    model.values["hypotheses"] = float(len(options.hypotheses))
    for a, b in combinations(options.hypotheses, 2):
        names = f"{_shown(a)} and {_shown(b)}"
        if a == b:
            model.add("same_hypotheses", a[0], names=names)
        elif all(x == y or abs(x + y - 1.0) < _EQUAL for x, y in zip(a, b, strict=True)):
            model.add("mirrored_hypotheses", a[0], names=names)
    for each, prior in zip(options.hypotheses, options.prior, strict=True):
        if {0.0, 1.0} & set(each):
            model.add("certain_rate.hypothesis", each[0], rates=_shown(each))
        if prior == 0.0 and options.weight_floor == 0.0:
            model.add("dead_hypothesis", 0.0, rates=_shown(each))


def _shown(rates: tuple[float, ...]) -> str:
    text = ", ".join(f"{rate:g}" for rate in rates)
    return f"({text})" if len(rates) > 1 else text


def _identification(model: Subject, faults: ActuatorFaults, likelihood: str) -> None:
    """Whether and how fast y can tell the hypotheses apart."""
    inputs, direct = model.spec.model.nu, model.D.any()
    if not direct and not any(reaches(model, j) for j in range(inputs)):
        model.add("unidentifiable")
        return
    model.add("needs_input")
    mixture = likelihood == "mixture" and faults.dependence == "independent"
    if not direct:
        model.add("slow_identification")
        model.add("no_feedthrough.bank")
    elif mixture and inputs > LARGEST_MIXTURE:
        model.add("gaussian_likelihood", inputs, most=LARGEST_MIXTURE)


def noise_factor(model: Subject) -> None:
    """A factor below one, or one that makes delta meaningless."""
    if (faults := model.spec.faults.sensor) is not None:
        model.values["noise_factor"] = faults.noise_factor
        if faults.noise_factor < 1.0:
            model.add("noise_factor", faults.noise_factor)


def distribution(model: Subject) -> None:
    """Rates at the start and in the long run; modes that never come; modes of no memory."""
    faults = model.spec.faults.sensor
    if faults is None or not faults.kernel:
        return
    kernel, initial = np.array(faults.kernel), np.array(faults.initial)
    model.put("initial_probability", _MODES, faults.initial)
    lasting = stationary_law(kernel)
    if lasting is not None:
        model.values["gamma_rate"] = float(lasting[:2].sum())
        model.values["delta_nominal_rate"] = float(lasting[[0, 2]].sum())
    never = [mode for mode, seen in zip(_MODES, visited(kernel, initial), strict=True) if not seen]
    if never:
        model.add("impossible_mode", len(never), names=listed(never))
    if model.spec.filter.traits.models == "mixed" and np.ptp(kernel, axis=0).max() <= _EQUAL:
        model.add("no_memory")


def lost_signal(model: Subject) -> None:
    """An unstable plant under a linear filter: the second moment of the state acts as noise."""
    spec, faults = model.spec, model.spec.faults.sensor
    if faults is None or not spec.filter.traits.moments:
        return
    if faults.moments is not None:
        rate = faults.moments.gamma_rate
    else:
        rate, lasting = sum(faults.initial[:2]), stationary_law(faults.kernel)
        rate = rate if lasting is None else min(rate, float(lasting[:2].sum()))
    if rate < 1.0 - _EQUAL and model.spectral_radius >= 1.0:
        model.add("unstable_linear", model.spectral_radius, rate=rate)


def compression_loss(model: Subject) -> None:
    """Variance after the first window over that of a Kalman filter, all rows at every sample."""
    spec, soft = model.spec, model.spec.faults.soft
    if spec.filter.traits.windows != "partial" or soft is None or soft.window > _LONGEST:
        return
    system = LinearSystem.from_spec(spec, soft.window + 1)
    design = replace(design_of(spec, soft.window), false_alarm=None)
    y, u = np.zeros((system.length, system.ny)), np.zeros((system.length, system.nu))
    compressed = np.diag(partial_compression(system, design, y, u).filtered_covariance[-1])
    prediction = system.x0, system.P0
    for k in range(system.length):
        step = textbook_step(system, k, prediction, y[k], u[k])
        prediction = step["predicted_state"], step["predicted_covariance"]
    kalman = np.diag(step["filtered_covariance"])
    ratio = np.divide(compressed, kalman, out=np.ones_like(kalman), where=kalman > 0.0)
    worst = int(np.argmax(ratio))
    loss = float(ratio[worst]) - 1.0
    model.values["compression_loss"] = loss
    if loss > _MUCH:
        remedy = 'maintenance = "optimal", ' * (spec.filter.options.maintenance == "paper")
        model.add("compression_loss", loss, name=model.states[worst], remedy=remedy)
