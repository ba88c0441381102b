"""Interacting multiple models over the conditions of a sensor, or over modes of the plant.

Blom & Bar-Shalom 1988; for sensors Sigalov & Oshman, sec. IV: one estimate per mode; before each
sample the estimates are mixed by what the chain says about the mode before, eqs. (17), (18). The
mode of sample k drives the step into x[k], and y[k].
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca

from fkgen.estimators.gaussian.actuation import certain
from fkgen.estimators.gaussian.estimate import (
    demand_finite,
    demand_positive,
    estimated,
    finite,
    propagate,
)
from fkgen.estimators.models.markov import Prediction, advance
from fkgen.estimators.models.merge import Mixer
from fkgen.estimators.models.modes import Modes, mean_noise, move_alike
from fkgen.estimators.models.switching import Switching
from fkgen.estimators.models.weights import TINY
from fkgen.problem import Spec
from fkgen.symbolic.builder import Script
from fkgen.symbolic.interface import Port
from fkgen.symbolic.linalg import column, split_packed
from fkgen.symbolic.plant import Plant
from fkgen.symbolic.ports import estimate_ports, prior_of
from fkgen.symbolic.recursion import Phase, Recursion

#: Timing of the modes where they move the state.
JUMPING = "the mode of sample k drives the step from x(k-1) to x(k), with parameters k-1, and y(k)"


def interacting_models(spec: Spec) -> Recursion:
    """Build the filter: a correction per mode, Bayes' rule, mixing, a prediction per mode."""
    count = spec.filter.options.modes
    filtering = Switching.of(spec, _mode_ports(spec.model.nx, count))
    x0, packed = prior_of(spec)
    initial = filtering.start()
    initial |= {f"mode_{of}state": x0 * count for of in ("", "filtered_")}
    initial |= {f"mode_{of}covariance": packed * count for of in ("", "filtered_")}
    jumps = spec.faults.jump is not None
    return Recursion(
        spec=spec,
        source="Blom & Bar-Shalom 1988, IEEE Trans. Automatic Control 33(8)"
        if jumps
        else "Sigalov & Oshman, sec. IV, eqs. (8), (15)-(18)",
        ports=filtering.ports,
        initial=initial,
        update=_update(filtering, count),
        predict=_predict(filtering),
        form=filtering.form,
        notes=(
            filtering.modes.note,
            *((JUMPING,) if jumps else ()),
        ),
    )


def _mode_ports(n: int, count: int) -> tuple[Port, ...]:
    ports: list[Port] = []
    for name, meaning in (("mode_", "x(k+1|k), mixed,"), ("mode_filtered_", "x(k|k)")):
        meanings = f"{meaning} under each mode", "its error covariance"
        ports += estimate_ports(name, (count, n), meanings)
    return tuple(ports)


def _parts(filtering: Switching, prefix: str, count: int) -> list[tuple[ca.SX, ca.SX]]:
    """(state, packed covariance) of every mode."""
    n, symbols = filtering.spec.model.nx, filtering.symbols
    states = ca.vertsplit(symbols[f"{prefix}state"], n)
    covariances = split_packed(symbols[f"{prefix}covariance"], n)
    return list(zip(states[:count], covariances[:count], strict=True))


def _update(filtering: Switching, count: int) -> Phase:
    script = Script(filtering.symbols)
    priors = _parts(filtering, "mode_", count)
    for _, packed in priors:
        demand_positive(script, packed, filtering.spec.model.nx)
    modes = filtering.bound(script, "CDR")
    each = [filtering.update(script, modes, j, prior) for j, prior in enumerate(priors)]
    weights, results = filtering.weigh(script, each)
    states, covariances = [one.state for one in each], [one.covariance for one in each]
    with script.titled("combination"):
        tiny = TINY[filtering.spec.code.scalar]
        parts = list(zip(states, covariances, strict=True))
        state, covariance = Mixer(script, "combined", parts, tiny).under(weights.probability)
        demand_finite(script, state)
        results |= {
            "filtered_state": state,
            "filtered_covariance": covariance,
            "mode_filtered_state": ca.vertcat(*states),
            "mode_filtered_covariance": ca.vertcat(*covariances),
        }
        script.put(results)
    return script.phase()


def _predict(filtering: Switching) -> Phase:
    script, symbols, spec = Script(filtering.symbols), filtering.symbols, filtering.spec
    modes = filtering.bound(script, "ABcQ")
    with script.titled("law of the next mode, and mixing weights"):
        now = (symbols["mode_probability"], symbols["log_weight"])
        law = advance(script, modes.kernel, now, spec.code.scalar, mixing=True)
    with script.titled("mixing and prediction of every mode"):
        moved = _moved(script, filtering, modes, law)
    with script.titled("combined prediction"):
        combined = _combined(script, filtering, modes.motions, moved, law.probability)
        states, covariances = zip(*(moved.each[at] for at in moved.which), strict=True)
        script.put(
            {
                "predicted_mode_probability": law.probability,
                "predicted_log_weight": law.logarithm,
                "mode_state": ca.vertcat(*states),
                "mode_covariance": ca.vertcat(*covariances),
                "predicted_state": combined[0],
                "predicted_covariance": combined[1],
            },
            [finite(*(sum(each[1:], start=each[0]) for each in zip(*moved.each, strict=True)))],
        )
    return script.phase()


@dataclass(frozen=True, slots=True)
class _Moved:
    """x(k+1|k): the estimates (mean, packed covariance), and which of them is that of each mode."""

    each: list[tuple[ca.SX, ca.SX]]
    which: list[int]


def _moved(script: Script, filtering: Switching, modes: Modes, law: Prediction) -> _Moved:
    """Mixed by (17), (18), then moved as the mode does; what is the same is computed once."""
    symbols, motions = filtering.symbols, modes.motions
    mixer = Mixer(
        script,
        "mixed",
        _parts(filtering, "mode_filtered_", len(motions)),
        TINY[filtering.spec.code.scalar],
    )
    mixed: dict[int, tuple[ca.SX, ca.SX]] = {}
    known: dict[tuple[int, int], int] = {}
    result = _Moved([], [])
    for j in modes.predicted_as:
        group, plant = law.group[j], motions[j]
        weights = law.mixing[group]
        if weights is symbols["mode_probability"]:  # nothing is learnt about the mode before
            mixed[group] = (symbols["filtered_state"], symbols["filtered_covariance"])
        elif group not in mixed:
            mixed[group] = mixer.under(weights, f"_{group}", law.columns[group])
        at = known.setdefault((group, id(plant)), len(result.each))
        if at == len(result.each):
            state, packed, _ = propagate(plant, certain(symbols["u"]), estimated(*mixed[group]))
            state = script.let(f"moved_state_{at}", state)
            result.each.append((state, script.let(f"moved_covariance_{at}", packed)))
        result.which.append(at)
    return result


def _combined(
    script: Script,
    filtering: Switching,
    motions: tuple[Plant, ...],
    moved: _Moved,
    probability: ca.SX,
) -> tuple[ca.SX, ca.SX]:
    """x(k+1|k) whatever the mode; where modes differ in nothing but Q, from x(k|k)."""
    symbols = filtering.symbols
    if move_alike(motions):
        plant = replace(motions[0], Q=mean_noise(motions, probability))
        estimate = estimated(symbols["filtered_state"], symbols["filtered_covariance"])
        return propagate(plant, certain(symbols["u"]), estimate)[:2]
    masses = [ca.SX(0) for _ in moved.each]
    for j, at in enumerate(moved.which):
        masses[at] += probability[j]
    tiny = TINY[filtering.spec.code.scalar]
    return Mixer(script, "predicted", moved.each, tiny).under(column(masses))
