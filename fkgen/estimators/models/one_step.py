"""One-step optimal filter: one Gaussian before every sample, the four sensor conditions in it.

Sigalov & Oshman, sec. III: given (gamma, delta) the correction is that of a Kalman filter; the four
are weighted by Bayes' rule (8) and reduced to one Gaussian again. How the covariance (7) is carried
on is an option, because the paper's equation holds without faults only.
"""

from __future__ import annotations

import casadi as ca

from fkgen.estimators.gaussian.actuation import certain
from fkgen.estimators.gaussian.estimate import (
    bound,
    demand_finite,
    demand_positive,
    estimated,
    finite,
    propagate,
)
from fkgen.estimators.models.markov import advance
from fkgen.estimators.models.switching import ModeUpdate, Switching
from fkgen.problem import Spec
from fkgen.symbolic.builder import Script
from fkgen.symbolic.interface import Port
from fkgen.symbolic.linalg import split_packed, spread, weighted_sum
from fkgen.symbolic.ports import carried, prior_of
from fkgen.symbolic.recursion import Phase, Recursion

MODES = 4

#: How many covariances run beside the estimate, as if no signal were ever lost.
RICCATIS = {"moment_matched": 0, "weighted": 0, "paper": 2, "paper_nominal": 1}


def one_step_optimal(spec: Spec) -> Recursion:
    """Build the filter: four corrections of one prior, Bayes' rule, one Gaussian."""
    beside = RICCATIS[spec.filter.options.covariance]
    filtering = Switching.of(spec, _riccati_ports(spec.model.nx, beside))
    initial = filtering.start()
    packed = prior_of(spec)[1] * beside
    if beside:
        initial |= {"riccati_covariance": packed, "riccati_filtered_covariance": packed}
    return Recursion(
        spec=spec,
        source="Sigalov & Oshman, sec. III, eqs. (3)-(14)",
        ports=filtering.ports,
        initial=initial,
        update=_update(filtering),
        predict=_predict(filtering),
        form=filtering.form,
        notes=(
            f"covariance: {spec.filter.options.covariance}",
            filtering.modes.note,
        ),
    )


def _riccati_ports(n: int, count: int) -> tuple[Port, ...]:
    if not count:
        return ()
    whose = "for delta = 1 and C" if count > 1 else "for delta = 1"
    shape, what = (count, n, n) if count > 1 else (n, n), f"as if gamma were always 1, {whose}"
    return (
        carried("riccati_covariance", shape, f"P(k+1|k) {what}", unit="xx", symmetric=True),
        carried("riccati_filtered_covariance", shape, f"P(k|k) {what}", unit="xx", symmetric=True),
    )


def _parts(filtering: Switching, port: str) -> list[ca.SX]:
    return split_packed(filtering.symbols[port], filtering.spec.model.nx)


def _update(filtering: Switching) -> Phase:
    script, symbols = Script(filtering.symbols), filtering.symbols
    beside = RICCATIS[filtering.spec.filter.options.covariance]
    parts = _parts(filtering, "riccati_covariance" if beside else "predicted_covariance")
    for packed in parts:
        demand_positive(script, packed, filtering.spec.model.nx)
    priors = parts * (MODES // len(parts))
    modes = filtering.bound(script, "CDR")
    each = [
        filtering.update(script, modes, j, (symbols["predicted_state"], priors[j]))
        for j in range(MODES)
    ]
    weights, results = filtering.weigh(script, each)
    with script.titled("combination"):
        results |= _combined(script, filtering, weights.probability, each)
        if beside:
            filtered = [one.covariance for one in each[:beside]]
            results["riccati_filtered_covariance"] = ca.vertcat(*filtered)
        script.put(results)
    return script.phase()


def _combined(
    script: Script, filtering: Switching, weights: ca.SX, each: list[ModeUpdate]
) -> dict[str, ca.SX]:
    """The estimate, and its covariance in the reading that was asked for."""
    states = [one.state for one in each]
    state = script.let("combined_state", weighted_sum(weights, states))
    demand_finite(script, state)
    covariance = weighted_sum(weights, [one.covariance for one in each])
    if filtering.spec.filter.options.covariance == "moment_matched":
        covariance += spread(weights, states, state)
    return {"filtered_state": state, "filtered_covariance": covariance}


def _predict(filtering: Switching) -> Phase:
    script, symbols, spec = Script(filtering.symbols), filtering.symbols, filtering.spec
    plant = bound(script, filtering.plants[0], "ABQ")
    now = (symbols["mode_probability"], symbols["log_weight"])
    with script.titled("law of the next mode"):
        law = advance(script, filtering.modes.kernel, now, spec.code.scalar, mixing=False)
    inputs = certain(symbols["u"])
    estimate = estimated(symbols["filtered_state"], symbols["filtered_covariance"])
    state, covariance, _ = propagate(plant, inputs, estimate)
    results = {
        "predicted_mode_probability": law.probability,
        "predicted_log_weight": law.logarithm,
        "predicted_state": state,
        "predicted_covariance": covariance,
    }
    guards = [finite(state, covariance)]
    if RICCATIS[spec.filter.options.covariance]:
        moved = [
            propagate(plant, inputs, estimated(symbols["filtered_state"], packed))[1]
            for packed in _parts(filtering, "riccati_filtered_covariance")
        ]
        results["riccati_covariance"] = ca.vertcat(*moved)
        guards += [finite(state, packed) for packed in moved]
    with script.titled("prediction of the next sample"):
        script.put(results, guards)
    return script.phase()
