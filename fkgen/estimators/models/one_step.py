"""``one_step`` (GPB1; Sigalov & Oshman, sec. III): one Gaussian before every sample.

The corrections under the modes are reduced to one Gaussian again. How the covariance (7) is carried
on is an option, because the paper's equation holds without faults only.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import casadi as ca

from fkgen.estimators.gaussian.actuation import certain
from fkgen.estimators.gaussian.estimate import (
    Posterior,
    bound,
    demand_finite,
    finite,
    off_by,
    propagate,
    propagate_factors,
)
from fkgen.estimators.gaussian.sequential import Conditioned
from fkgen.estimators.gaussian.ud import (
    Factors,
    factors_note,
    packed_factors,
)
from fkgen.estimators.models.merge import (
    Gaussian,
    mixture_covariance,
    spread_weights,
)
from fkgen.estimators.models.switching import Switching
from fkgen.problem import Spec
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.interface import Port, triangle
from fkgen.symbolic.lifting.linearise import moved_from
from fkgen.symbolic.linalg import (
    congruence,
    split_packed,
    unpack,
    weighted_sum,
)
from fkgen.symbolic.plant import Plant
from fkgen.symbolic.ports import (
    carried,
    factor_ports,
)
from fkgen.symbolic.recursion import Phase, Recursion

#: How many covariances of one_step run beside the estimate, as if no signal were ever lost.
_RICCATIS = {"moment_matched": 0, "weighted": 0, "paper": 2, "paper_nominal": 1}


def one_step_optimal(spec: Spec) -> Recursion:
    """Build ``one_step``: corrections of one prior, Bayes' rule, one Gaussian."""
    option = spec.filter.options.covariance
    beside = _RICCATIS[option]
    ports, factors = _riccati_ports(spec, beside)
    filtering = Switching.of(spec, ports, factors, merges_errors=True)
    symbols, plant = filtering.symbols, filtering.plants[0]

    def combined(
        builder: PhaseBuilder, weights: ca.SX, each: list[Conditioned]
    ) -> dict[str, ca.SX]:
        parts = [(one.mean, one.covariance) for one in each]
        covariances = [packed for _, packed in parts]
        state = builder.define("combined_state", weighted_sum(weights, [mean for mean, _ in parts]))
        demand_finite(builder, state)
        covariance = weighted_sum(weights, covariances)
        if option == "moment_matched":
            scalar = spec.code.scalar
            outer = spread_weights(builder, "combined", weights, parts, state, scalar=scalar)
            covariance = mixture_covariance(weights, parts, state, outer)
        alone = covariances[:beside]
        if plant.attitudes:
            errors, n = state, plant.ne
            state, turn = off_by(builder, plant, symbols["predicted_state"], errors)
            covariance = congruence(turn, unpack(covariance, n))
            alone = [congruence(turn, unpack(each, n)) for each in alone]
        results = {"filtered_state": state, "filtered_covariance": covariance}
        if beside:
            results["riccati_filtered_covariance"] = ca.vertcat(*alone)
        return results

    name = "riccati_{}" if beside else "predicted_{}"
    known: Sequence[ca.SX | Factors] = split_packed(
        symbols[name.format("covariance")], spec.model.ne
    )
    if filtering.order:
        known = filtering.factors(name.format("factors"))
    priors = [(symbols["predicted_state"], known[j % len(known)]) for j in range(4)]
    factored = partial(_merged_factors, filtering, beside, matched=option == "moment_matched")
    update = filtering.update(priors, factored if filtering.order else combined)
    phases = update, _one_prediction(filtering, beside)
    notes = f"covariance: {option}", filtering.modes.note, *factors_note(filtering.order, spec)
    return filtering.recursion("Sigalov & Oshman, sec. III, eqs. (3)-(14)", phases, *notes)


def _merged_factors(
    filtering: Switching,
    beside: int,
    builder: PhaseBuilder,
    weights: ca.SX,
    each: list[Conditioned],
    *,
    matched: bool,
) -> dict[str, ca.SX]:
    """What ``one_step`` keeps of four corrections, with the factors of its covariances."""
    state, held = filtering.merged(builder, ca.vertsplit(weights), each, spread=matched)
    state = builder.define("combined_state", state)
    demand_finite(builder, state)
    results = {
        "filtered_state": state,
        "filtered_covariance": held.covariance(),
        "filtered_factors": held.packed,
    }
    if beside:
        alone = [one.factors for one in each[:beside] if one.factors is not None]
        results["riccati_filtered_covariance"] = ca.vertcat(*(a.covariance() for a in alone))
        results["riccati_filtered_factors"] = packed_factors(alone)
    return results


def _riccati_ports(spec: Spec, count: int) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
    """Covariances beside that of x, and factors of all of them."""
    n = spec.model.ne
    shape = (count, n, n) if count > 1 else (n, n)
    what = f"as if gamma were always 1, for delta = 1{' and C' if count > 1 else ''}"
    covariance = partial(carried, unit="xx", symmetric=True, prior="P")
    ports = (
        covariance("riccati_covariance", shape, f"P(k+1|k) {what}"),
        covariance("riccati_filtered_covariance", shape, f"P(k|k) {what}"),
    )
    factors = factor_ports(n)
    if not count:
        return (), factors
    size = (count, len(triangle(n))) if count > 1 else (len(triangle(n)),)
    names = "riccati_factors", "riccati_filtered_factors"
    beside = (carried(f, size, f"factors of {p.name}") for f, p in zip(names, ports, strict=True))
    return ports, (*factors, *beside)


def _one_prediction(filtering: Switching, beside: int) -> Phase:
    builder, symbols, spec = PhaseBuilder(filtering.symbols), filtering.symbols, filtering.spec
    plant = bound(builder, filtering.plants[0], "ABQc")
    now = (symbols["mode_probability"], symbols["log_weight"])
    with builder.titled("law of the next mode"):
        law = filtering.modes.advanced(builder, now, spec.code.scalar, mixing=False)
    packed = [symbols["filtered_covariance"]]
    if beside:
        packed += split_packed(symbols["riccati_filtered_covariance"], spec.model.ne)
    inputs, mean = certain(symbols["u"]), symbols["filtered_state"]
    (plant,) = moved_from(builder, [plant], [mean], symbols["u"])
    results: dict[str, ca.SX] = {}
    if filtering.order:
        moved, results = _moved_factors(builder, filtering, plant, beside)
    else:
        moved = [
            propagate(builder, plant, inputs, Posterior(mean, each), f"_{at}")[:2]
            for at, each in enumerate(packed)
        ]
    state = moved[0][0]
    results |= {
        "predicted_mode_probability": law.probability,
        "predicted_log_weight": law.logarithm,
        "predicted_state": state,
        "predicted_covariance": moved[0][1],
        **filtering.anew(),
    }
    if beside:
        results["riccati_covariance"] = ca.vertcat(*(each for _, each in moved[1:]))
    with builder.titled("prediction of the next sample"):
        builder.assign(results, [finite(state, each) for _, each in moved])
    return builder.phase()


def _moved_factors(
    builder: PhaseBuilder, filtering: Switching, plant: Plant, beside: int
) -> tuple[list[Gaussian], dict[str, ca.SX]]:
    """Predictions of one mean with the covariances there are, and the ports of their factors."""
    symbols, moved, ports = filtering.symbols, list[Gaussian](), dict[str, ca.SX]()
    estimate = Posterior(symbols["filtered_state"], symbols["filtered_covariance"])
    names = {"filtered_factors": "predicted_factors"}
    names |= {"riccati_filtered_factors": "riccati_factors"} if beside else {}
    for name, later in names.items():
        found = []
        for at, held in enumerate(filtering.factors(name)):
            state, next_, _ = propagate_factors(plant, certain(symbols["u"]), estimate, held)
            found.append(next_.named(builder, f"next_{later}_{at}"))
            moved.append((state, found[-1].covariance()))
        ports[later] = packed_factors(found)
    return moved, ports
