"""Interacting multiple models over the conditions of the sensor.

Sigalov & Oshman, sec. IV (Blom & Bar-Shalom 1988): one estimate per mode; before each sample the
estimates are mixed by what the chain says about the mode before, eqs. (17), (18).
"""

from __future__ import annotations

from functools import partial

import casadi as ca

from fkgen.families.family import Family
from fkgen.families.sensor_caveats import three_modes
from fkgen.families.sensor_evidence import ENUMERATION, IMM
from fkgen.spec import Spec
from fkgen.symbolic.actuation import certain
from fkgen.symbolic.estimate import (
    bound,
    demand_finite,
    demand_positive,
    estimated,
    finite,
    propagate,
)
from fkgen.symbolic.interface import Port, Role
from fkgen.symbolic.markov import Prediction, advance
from fkgen.symbolic.mixture import Mixer
from fkgen.symbolic.plant import Plant, plant_of
from fkgen.symbolic.ports import prior_of
from fkgen.symbolic.recursion import Phase, Recursion
from fkgen.symbolic.script import Script
from fkgen.symbolic.switching import Switching, modes_of
from fkgen.symbolic.weights import TINY


def build(spec: Spec) -> Recursion:
    """Build the filter: a correction per mode, Bayes' rule, mixing, a prediction per mode."""
    count = spec.filter.modes
    filtering = Switching.of(spec, _mode_ports(spec.model.nx, count), count)
    modes = modes_of(plant_of(spec), filtering.faults, count)
    x0, packed = prior_of(spec)
    initial = filtering.start(modes.initial)
    initial |= {f"mode_{of}state": x0 * count for of in ("", "filtered_")}
    initial |= {f"mode_{of}covariance": packed * count for of in ("", "filtered_")}
    return Recursion(
        spec=spec,
        source="Sigalov & Oshman, sec. IV, eqs. (8), (15)-(18)",
        ports=filtering.ports,
        initial=initial,
        update=_update(filtering, count),
        predict=_predict(filtering, modes.kernel),
        notes=(f"covariance update: {filtering.form} form", modes.note),
    )


def _mode_ports(n: int, count: int) -> tuple[Port, ...]:
    port = partial(Port, role=Role.STATE)
    ports = []
    for name, meaning in (("mode_", "x(k+1|k), mixed,"), ("mode_filtered_", "x(k|k)")):
        ports += [
            port(name=f"{name}state", shape=(count, n), meaning=f"{meaning} under each mode"),
            port(
                name=f"{name}covariance",
                shape=(count, n, n),
                symmetric=True,
                meaning="its error covariance",
            ),
        ]
    return tuple(ports)


def _parts(filtering: Switching, prefix: str, count: int) -> list[tuple[ca.SX, ca.SX]]:
    """(state, packed covariance) of every mode."""
    n, symbols = filtering.plant.nx, filtering.symbols
    states = ca.vertsplit(symbols[f"{prefix}state"], n)
    covariances = ca.vertsplit(symbols[f"{prefix}covariance"], n * (n + 1) // 2)
    return list(zip(states[:count], covariances[:count], strict=True))


def _update(filtering: Switching, count: int) -> Phase:
    script = Script(filtering.symbols)
    priors = _parts(filtering, "mode_", count)
    for _, packed in priors:
        demand_positive(script, packed, filtering.plant.nx)
    modes = filtering.modes(script, count)
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


def _predict(filtering: Switching, kernel: tuple[tuple[float, ...], ...]) -> Phase:
    script, symbols, spec = Script(filtering.symbols), filtering.symbols, filtering.spec
    plant = bound(script, filtering.plant, "ABQ")
    with script.titled("law of the next mode, and mixing weights"):
        now = (symbols["mode_probability"], symbols["log_weight"])
        law = advance(script, kernel, now, spec.code.scalar, mixing=True)
    with script.titled("mixing and prediction of every mode"):
        moved = _moved(script, filtering, plant, law)
    with script.titled("combined prediction"):
        estimate = estimated(symbols["filtered_state"], symbols["filtered_covariance"])
        combined = propagate(plant, certain(symbols["u"]), estimate)[:2]
        states, covariances = zip(*(moved[at] for at in law.group), strict=True)
        script.put(
            {
                "predicted_mode_probability": law.probability,
                "predicted_log_weight": law.logarithm,
                "mode_state": ca.vertcat(*states),
                "mode_covariance": ca.vertcat(*covariances),
                "predicted_state": combined[0],
                "predicted_covariance": combined[1],
            },
            [finite(*(sum(each[1:], start=each[0]) for each in zip(*moved, strict=True)))],
        )
    return script.phase()


def _moved(
    script: Script, filtering: Switching, plant: Plant, law: Prediction
) -> list[tuple[ca.SX, ca.SX]]:
    """For every group of targets: mixed by (17), (18), then propagated."""
    symbols, result = filtering.symbols, []
    parts = _parts(filtering, "mode_filtered_", len(law.group))
    mixer = Mixer(script, "mixed", parts, TINY[filtering.spec.code.scalar])
    for at, (weights, column) in enumerate(zip(law.mixing, law.columns, strict=True)):
        if weights is symbols["mode_probability"]:  # nothing is learnt about the mode before
            mixed = (symbols["filtered_state"], symbols["filtered_covariance"])
        else:
            mixed = mixer.under(weights, f"_{at}", column)
        state, covariance, _ = propagate(plant, certain(symbols["u"]), estimated(*mixed))
        moved_state = script.let(f"moved_state_{at}", state)
        result.append((moved_state, script.let(f"moved_covariance_{at}", covariance)))
    return result


FAMILY = Family(
    name="imm",
    title="sensors that lose their signal or gain noise: interacting multiple models",
    build=build,
    closed_forms=(IMM, ENUMERATION),
    caveats=three_modes,
)
