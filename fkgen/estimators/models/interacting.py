"""``imm`` (Blom & Bar-Shalom 1988; Sigalov & Oshman, sec. IV): one estimate per mode.

Before each sample they are mixed by what the chain says about the mode before, eqs. (17), (18). The
mode of sample k drives the step into x[k], and y[k].
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca

from fkgen.estimators.gaussian.actuation import certain
from fkgen.estimators.gaussian.decorrelation import correlated_rows
from fkgen.estimators.gaussian.estimate import (
    Posterior,
    demand_finite,
    propagate,
    propagate_factors,
)
from fkgen.estimators.gaussian.sequential import Conditioned, Prior
from fkgen.estimators.gaussian.ud import (
    Factors,
    Wide,
    factors_note,
    merged,
    packed_factors,
)
from fkgen.estimators.models.merge import (
    Chart,
    Gaussian,
    Mixer,
)
from fkgen.estimators.models.modes import Modes, mean_noise, move_alike, of_states
from fkgen.estimators.models.switching import Switching
from fkgen.estimators.models.weights import (
    Prediction,
)
from fkgen.problem import Spec
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.lifting.linearise import moved_from
from fkgen.symbolic.linalg import (
    column,
    is_zero,
    split_estimates,
)
from fkgen.symbolic.plant import Plant
from fkgen.symbolic.ports import (
    mode_estimate_ports,
    mode_factor_ports,
)
from fkgen.symbolic.recursion import Phase, Recursion

#: Timing of the modes where they move the state.
_JUMPING = "the mode of sample k drives the step from x(k-1) to x(k), with parameters k-1, and y(k)"


def interacting_models(spec: Spec) -> Recursion:
    """Build ``imm``: a correction per mode, Bayes' rule, mixing, a prediction per mode."""
    means = "x(k+1|k), mixed, under each mode", "x(k|k) under each mode"
    count = spec.filter.options.modes
    factors = mode_factor_ports(spec.model.ne, [0] * count)
    filtering = Switching.of(spec, mode_estimate_ports(spec, count, means), factors)
    order = filtering.order

    def combined(
        builder: PhaseBuilder, weights: ca.SX, each: list[Conditioned]
    ) -> dict[str, ca.SX]:
        parts = [(one.mean, one.covariance) for one in each]
        chart = Chart(builder, filtering.plants[0], "combination", parts[0][0])
        flat = chart.inward(parts)
        lasting = filtering.modes.forgets and not order
        mixer = Mixer(builder, "combined", flat, spec.code.scalar, lasting=lasting)
        state, covariance = chart.outward(mixer.under(weights))
        demand_finite(builder, state)
        held = packed_factors(one.factors for one in each)
        return ({"mode_filtered_factors": held} if order else {}) | {
            "filtered_state": state,
            "filtered_covariance": covariance,
            "mode_filtered_state": ca.vertcat(*(mean for mean, _ in parts)),
            "mode_filtered_covariance": ca.vertcat(*(packed for _, packed in parts)),
        }

    symbols = filtering.symbols
    own = split_estimates(symbols["mode_state"], symbols["mode_covariance"], spec.model.nx)
    priors: list[Prior] = [*own]
    if order:
        means_ = [mean for mean, _ in own]
        priors = [*zip(means_, filtering.factors("mode_factors"), strict=True)]
    elif spec.faults.jump is not None:
        pairs = zip(own, spec.faults.jump.modes, strict=True)
        priors = [of_states(prior, mode.kept) for prior, mode in pairs]
    phases = filtering.update(priors, combined), _predictions(filtering)
    source, notes = "Sigalov & Oshman, sec. IV, eqs. (8), (15)-(18)", [filtering.modes.note]
    notes += factors_note(order, spec)
    if spec.faults.jump is not None:
        source = "Blom & Bar-Shalom 1988, IEEE Trans. Automatic Control 33(8)"
        notes.append(_JUMPING)
    lumped = any(len(variants) > 1 for variants in filtering.modes.variants)
    repeats = None if lumped else correlated_rows([plant.R for plant in filtering.plants])
    return filtering.recursion(source, phases, *notes, repeats=repeats)


def _predictions(filtering: Switching) -> Phase:
    builder, symbols, spec = PhaseBuilder(filtering.symbols), filtering.symbols, filtering.spec
    modes = filtering.bound(builder, "ABcQ")
    with builder.titled("law of the next mode, and mixing weights"):
        now = (symbols["mode_probability"], symbols["log_weight"])
        law = modes.advanced(builder, now, spec.code.scalar, mixing=True)
    factors: list[Factors] = []
    with builder.titled("mixing and prediction of every mode"):
        if filtering.order:
            moved, which, factors = _moved_in_factors(builder, filtering, modes, law)
        else:
            moved, which = _moved(builder, filtering, modes, law)
    with builder.titled("combined prediction"):
        motions = modes.motions
        combined = _combined(builder, filtering, motions, (moved, which), law.probability)
        held = packed_factors(factors[at] for at in which) if factors else ca.SX(0, 1)
        builder.assign(
            ({"mode_factors": held} if factors else {})
            | {
                "predicted_mode_probability": law.probability,
                "predicted_log_weight": law.logarithm,
                "mode_state": ca.vertcat(*(moved[at][0] for at in which)),
                "mode_covariance": ca.vertcat(*(moved[at][1] for at in which)),
                "predicted_state": combined[0],
                "predicted_covariance": combined[1],
                **filtering.anew(),
            }
        )
    return builder.phase()


def _moved(
    builder: PhaseBuilder, filtering: Switching, modes: Modes, law: Prediction
) -> tuple[list[Gaussian], list[int]]:
    """Estimates mixed by (17), (18), then moved as the mode does, and which is that of each mode.

    What is the same is computed once.
    """
    symbols, motions = filtering.symbols, modes.motions
    filtered = filtering.filtered()
    chart = Chart(builder, motions[0], "mixing", filtered[0][0])
    mixer = Mixer(builder, "mixed", chart.inward(filtered), filtering.spec.code.scalar)
    mixed: dict[int, Gaussian] = {}
    known: dict[tuple[int, int], int] = {}
    moved: list[Gaussian] = []
    which = []
    for j in modes.predicted_as:
        group, plant = law.group[j], motions[j]
        if law.mixing[group] is symbols["mode_probability"]:  # says nothing of the mode before
            mixed[group] = (symbols["filtered_state"], symbols["filtered_covariance"])
        elif group not in mixed:
            merged = mixer.under(law.mixing[group], f"_{group}", law.columns[group])
            mixed[group] = chart.outward(merged, f"_{group}")
        at = known.setdefault((group, id(plant)), len(moved))
        if at == len(moved):
            (plant,) = moved_from(builder, [plant], [mixed[group][0]], symbols["u"], f"_{at}")
            inputs, tag = certain(symbols["u"]), f"_{at}"
            state, packed, _ = propagate(builder, plant, inputs, Posterior(*mixed[group]), tag)
            state = builder.define(f"moved_state_{at}", state)
            moved.append((state, builder.define(f"moved_covariance_{at}", packed)))
        which.append(at)
    return moved, which


def _moved_in_factors(
    builder: PhaseBuilder, filtering: Switching, modes: Modes, law: Prediction
) -> tuple[list[Gaussian], list[int], list[Factors]]:
    """The same in factors: mixing and prediction are one orthogonalisation for each mode."""
    symbols, motions, u = filtering.symbols, modes.motions, filtering.symbols["u"]
    filtered, factors = filtering.filtered(), filtering.factors("mode_filtered_factors")
    chart = Chart(builder, motions[0], "mixing", filtered[0][0])
    parts = [(mean, each) for (mean, _), each in zip(chart.inward(filtered), factors, strict=True)]
    mixed: dict[int, tuple[ca.SX, Wide]] = {}
    known: dict[tuple[int, int], int] = {}
    moved, held, which = list[Gaussian](), list[Factors](), list[int]()
    for j in modes.predicted_as:
        group, plant = law.group[j], motions[j]
        if group not in mixed:
            weights = law.mixing[group]
            alive = [i for i in range(len(parts)) if not is_zero(weights[i])] or [0]
            shares = [weights[i] for i in alive] if len(alive) > 1 else [ca.SX(1)]
            mean, wide = merged(shares, [parts[i] for i in alive])
            mean = builder.define(f"mixed_{group}_mean", mean)
            mixed[group] = chart.outward((mean, ca.SX()), f"_{group}")[0], wide
        at = known.setdefault((group, id(plant)), len(moved))
        if at == len(moved):
            state, wide = mixed[group]
            (plant,) = moved_from(builder, [plant], [state], u, f"_{at}")
            estimate = Posterior(state, symbols["filtered_covariance"])
            state, next_, _ = propagate_factors(plant, certain(u), estimate, wide)
            held.append(next_.named(builder, f"next_factors_{at}"))
            state = builder.define(f"moved_state_{at}", state)
            covariance = builder.define(f"moved_covariance_{at}", held[-1].covariance())
            moved.append((state, covariance))
        which.append(at)
    return moved, which, held


def _combined(
    builder: PhaseBuilder,
    filtering: Switching,
    motions: tuple[Plant, ...],
    moved: tuple[list[Gaussian], list[int]],
    probability: ca.SX,
) -> Gaussian:
    """x(k+1|k) whatever the mode; where modes differ in nothing but Q, from x(k|k)."""
    symbols = filtering.symbols
    if motions[0].lifted is None and move_alike(motions) and not filtering.order:
        plant = replace(motions[0], Q=mean_noise(motions, probability))
        estimate = Posterior(symbols["filtered_state"], symbols["filtered_covariance"])
        return propagate(builder, plant, certain(symbols["u"]), estimate, "_combined")[:2]
    masses = [ca.SX(0) for _ in moved[0]]
    for j, at in enumerate(moved[1]):
        masses[at] += probability[j]
    chart = Chart(builder, motions[0], "prediction", moved[0][0][0])
    parts = chart.inward(moved[0])
    mixer = Mixer(builder, "predicted", parts, filtering.spec.code.scalar, lasting=False)
    return chart.outward(mixer.under(column(masses)))
